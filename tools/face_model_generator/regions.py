"""The regions of the default model and where they lie."""

from __future__ import annotations

import numpy as np

from face_model_generator.layout import inside_polygon
from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model.annotation import MOUTH_REGION, Region

MIDDLE_REGIONS = ("forehead", "nose", "upper_lip", "lower_lip", "chin", MOUTH_REGION)
"""Regions that straddle the midline; the others exist left and right."""

# name: (stiffness, specular scale, inpaint). Skull under thin skin is stiff, lips and jaw move with every
# expression. Oily skin of forehead and nose shines, hair of brows and lashes hardly does.
_TRAITS: dict[str, tuple[float, float, bool]] = {
    "forehead": (2.0, 1.3, True),
    "brow": (1.2, 0.6, False),
    "eye": (0.9, 0.8, False),
    "nose": (1.8, 1.5, True),
    "nostril": (1.2, 0.6, True),
    "cheek": (1.0, 1.0, True),
    "upper_lip": (0.5, 1.1, False),
    "lower_lip": (0.4, 1.1, False),
    "chin": (0.7, 1.0, True),
    "jaw": (0.6, 0.7, True),
    "temple": (1.6, 0.9, True),
    MOUTH_REGION: (0.05, 0.5, False),
}


def default_regions() -> dict[str, Region]:
    """Return the regions by name, index 0 upward: left and right of a pair follow each other."""
    names = []
    for name in _TRAITS:
        names += [name] if name in MIDDLE_REGIONS else [f"left_{name}", f"right_{name}"]
    return {
        name: Region(name, index, *_TRAITS[name.removeprefix("left_").removeprefix("right_")])
        for index, name in enumerate(names)
    }


def half_region_names(centroids: FloatArray, curves: dict[str, FloatArray]) -> list[str]:
    """Return the region (without side) of each face of the left half.

    Parameters
    ----------
    centroids : (F, 3) float64
        Face centroids in the design frame (origin at the nasion, mm).
    curves : dict of str to (N, 3) float64
        Feature curves of the half in the same frame; lips end at the mouth line.
    """
    names = np.full(len(centroids), "cheek", dtype=object)
    # The first polygon that holds the centroid wins: paint in reverse.
    for name, polygon in reversed(_front_polygons(curves)):
        names[inside_polygon(centroids[:, :2], polygon)] = name
    rim = curves["nose_rim"]
    inside = np.array([7.6, -49.6, np.interp(7.6, rim[:, 0], rim[:, 2]) - 4.0])
    nostril = np.linalg.norm((centroids - inside) / [5.2, 3.4, 5.6], axis=1) < 1
    names[nostril] = "nostril"
    return names.tolist()


def without_spikes(names: list[str], neighbours: list[list[int]], passes: int = 2) -> list[str]:
    """Give each face whose neighbours mostly agree on another region that region: borders turn smooth.

    Faces do not change sides of the mouth line, which is exact as it is; nostrils, a few faces each, and the
    film stay.

    >>> without_spikes(["a", "b", "a", "a"], [[1], [0, 2, 3], [1], [1]])
    ['a', 'a', 'a', 'a']
    """
    lips, current = {"upper_lip", "lower_lip"}, list(names)
    for _ in range(passes):
        before = list(current)
        for face, around in enumerate(neighbours):
            if before[face] in ("nostril", MOUTH_REGION):
                continue
            others = [before[k] for k in around if before[k] != MOUTH_REGION]
            for candidate in sorted(set(others) - {before[face]}):
                if others.count(candidate) >= 2 and {candidate, before[face]} != lips:
                    current[face] = candidate
    return current


def in_one_piece(names: list[str], neighbours: list[list[int]]) -> list[str]:
    """Give faces cut off from the largest piece of their region to the region around them.

    >>> in_one_piece(["a", "a", "b", "a"], [[1], [0, 2], [1, 3], [2]])
    ['a', 'a', 'b', 'b']
    """
    current = list(names)
    for name in sorted(set(names)):
        pieces = _pieces({face for face, own in enumerate(names) if own == name}, neighbours)
        for piece in pieces[1:]:
            around = [names[k] for face in piece for k in neighbours[face] if names[k] != name]
            for face in piece:
                current[face] = max(sorted(set(around)), key=around.count)
    return current


def _pieces(faces: set[int], neighbours: list[list[int]]) -> list[set[int]]:
    """Return the edge-connected pieces of a set of faces, largest first."""
    pieces, left = [], set(faces)
    while left:
        piece, front = set(), [min(left)]
        while front:
            face = front.pop()
            if face in left:
                left.remove(face)
                piece.add(face)
                front += neighbours[face]
        pieces.append(piece)
    return sorted(pieces, key=len, reverse=True)


def _front_polygons(curves: dict[str, FloatArray]) -> list[tuple[str, FloatArray]]:
    """Return closed polygons in the front view (x, y), most particular first."""
    line = curves["mouth_line"][:, :2]
    under_nose = [(-1, -53.2), (6, -53.2), (12, -52.4), (17.5, -50.2)]
    chin_top = [(18, -88), (0, -91.5), (-1, -91.5)]
    rows: list[tuple[str, list[tuple[float, float]]]] = [
        ("eye", [(13.5, -6.5), (17, 2), (23, 6.5), (32, 8), (42, 6), (49, 0.5), (51, -4.5), (46, -10),
                 (38, -13), (28, -13), (19, -11)]),
        ("brow", [(8, 10), (9, 23), (20, 28), (38, 30), (51, 26), (62, 15), (58, 8), (50, 1), (42, 6),
                  (32, 8), (23, 6.5), (16, 5)]),
        ("nose", [(-1, 4), (6, 3), (11, -6), (14, -14), (17, -24), (18.3, -34), (19, -43), (17.5, -50.2),
                  (12, -52.4), (6, -53.2), (-1, -53.2)]),
        ("upper_lip", [*under_nose, (22, -58), (27, -67), (29.5, -75), *map(tuple, line[::-1]),
                       (-1, line[0, 1])]),
        ("lower_lip", [(-1, line[0, 1]), *map(tuple, line), (29.5, -75), (26, -82), *chin_top]),
        ("chin", [*chin_top[::-1], (26, -85), (30, -96), (28, -130), (-1, -130)]),
        ("jaw", [(29.5, -75), (45, -66), (60, -52), (90, -40), (90, -130), (28, -130), (30, -96), (26, -85),
                 (26, -82)]),
        ("temple", [(46, 48), (52, 26), (60, 14), (57, 6), (56, -4), (66, -10), (90, -12), (90, 60),
                    (50, 60)]),
        ("forehead", [(-1, 4), (6, 3), (11, 2), (16, 5), (30, 8), (60, 14), (56, 60), (40, 80), (-1, 80)]),
    ]  # fmt: skip
    return [(name, np.array(polygon, float)) for name, polygon in rows]
