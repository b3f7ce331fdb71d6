"""What hides, changes or cuts off the face in raw stereo: glasses, beards, hair, an open mouth, scraps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import normalized, vertex_components, vertex_normals
from scan2albedo.synthetic.head import Mesh, compact, grid_faces
from scan2albedo.synthetic.textures import smoothstep

FEATURES = ("glasses", "open mouth", "beard", "fringe", "half face", "no neck")
"""What may hide or change a face, and the `_CHANCES` of each."""
_CHANCES = (0.3, 0.25, 0.2, 0.25, 0.1, 0.4)
SCRAPS = ("hair", "ear", "cheek", "neck", "forehead", "back")
"""Places of which alone a scrap may show something, see `scrap_of`."""
FEATURE_LANDMARKS = slice(17, 68)
"""Of brows, eyes, nose and mouth among the 68 of iBUG."""
_SCRAP_REACH_MM = (35.0, 90.0)
_SCRAP_SHARE, _SCRAP_MARGIN_MM = 0.15, 5.0
"""A scrap ends this far before more of the landmarks of brows, eyes, nose and mouth."""
_FEWEST_FACES = 60
_EYES, _MOUTH, _CHIN, _BROWS, _NOSE_BASE = slice(36, 48), slice(48, 68), 8, slice(17, 27), 33
_FOREHEAD = 0.9
"""Height of a forehead, in distances from the brows to the base of the nose."""


@dataclass(frozen=True)
class Head:
    """A head in mm that looks along +z, +y up, and its 68 landmarks (iBUG order), its mouth shut.

    `vertices` (V, 3) and `faces` (F, 3) hold all of it; `front` is its face, and `front_normals` are that
    mesh's, on which hair falls.
    """

    vertices: FloatArray
    faces: IntArray
    landmarks: FloatArray
    front: Mesh
    front_normals: FloatArray

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray, landmarks: FloatArray) -> Head:
        """Return the head; its face is what is turned forward between chin, temples and hairline."""
        normals = vertex_normals(vertices, faces)
        brow = landmarks[_BROWS, 1].mean()
        top = brow + _FOREHEAD * (brow - landmarks[_NOSE_BASE, 1])
        offset = vertices - landmarks.mean(0)
        forward = (normals[:, 2] > 0.2) & (np.abs(offset[:, 0]) < np.ptp(landmarks[:, 0]) / 2)
        between = (vertices[:, 1] > landmarks[_CHIN, 1]) & (vertices[:, 1] < top)
        kept = (forward & between & (vertices[:, 2] > landmarks[:17, 2].min()))[faces].all(1)
        used = np.unique(faces[kept])
        return cls(vertices, faces, landmarks, compact(vertices, faces[kept]), normals[used])


def drawn_features(wanted: tuple[str, ...] | None, rng: np.random.Generator) -> tuple[str, ...]:
    """Return the names wanted, drawn where that is None; ValueError for an unknown one."""
    drawn = rng.uniform(size=len(FEATURES)) < _CHANCES
    if wanted is None:
        return tuple(name for name, there in zip(FEATURES, drawn, strict=True) if there)
    unknown = sorted(set(wanted) - set(FEATURES))
    if unknown:
        raise ValueError(f"unknown features {unknown}, expected some of {FEATURES}")
    return tuple(wanted)


def shaped(head: Head, features: tuple[str, ...], rng: np.random.Generator) -> FloatArray:
    """Return the head's vertices (V, 3) with a jaw that is down, and a beard that stands off."""
    landmarks, vertices = head.landmarks, head.vertices.copy()
    mouth, chin = landmarks[_MOUTH].mean(0), landmarks[_CHIN]
    if "open mouth" in features:
        drop = rng.uniform(6, 22)
        below = smoothstep((mouth[1] - vertices[:, 1]) / 6) * _near(vertices, chin, 45)
        vertices[:, 1] -= drop * below
        vertices[:, 2] -= 0.35 * drop * below
        center, size = mouth - [0, drop / 2, 0], np.array([rng.uniform(14, 24), drop / 2 + 3, 30])
        inside = np.exp(-((np.abs((vertices - center) / size) ** 2).sum(1) ** 2))
        vertices[:, 2] -= rng.uniform(6, 16) * inside
    if "beard" in features:
        lower = smoothstep((mouth[1] + 4 - vertices[:, 1]) / 14) * _near(vertices, chin, 55)
        lower *= 1 - _near(vertices, mouth, 12)
        tufts = 1 + 0.35 * rng.normal(size=len(vertices))
        vertices += (rng.uniform(3, 12) * lower * tufts)[:, None] * vertex_normals(vertices, head.faces)
    return vertices


def _near(points: FloatArray, center: FloatArray, radius_mm: float) -> FloatArray:
    """Return (N,) 1 at a centre (3,), falling to 0 over its surroundings."""
    return np.exp(-0.5 * (((points - center) / radius_mm) ** 2).sum(1) ** 2)


def worn(head: Head, features: tuple[str, ...], rng: np.random.Generator) -> list[Mesh]:
    """Return the meshes of hair over the forehead and of the rims of glasses."""
    parts: list[Mesh] = []
    landmarks, (vertices, faces) = head.landmarks, head.front
    if "fringe" in features:
        brow = landmarks[_BROWS, 1].mean()
        top = vertices[:, 1].max()
        x = vertices[:, 0]
        ragged = 4 * np.sin(x / rng.uniform(3, 6)) + rng.uniform(-0.3, 0.3) * x
        above = vertices[:, 1] > top - rng.uniform(0.3, 0.75) * (top - brow) + ragged
        locks = rng.uniform(3, 9) * (1 + 0.2 * np.sin(x / 2.2))
        parts.append(compact(vertices + locks[:, None] * head.front_normals, faces[above[faces].all(1)]))
    if "glasses" in features:
        size = np.array([rng.uniform(22, 30), rng.uniform(16, 24)])
        parts += [_rim(center, size, rng.uniform(1.5, 4)) for center in _lens_centers(landmarks)]
    return parts


def _lens_centers(landmarks: FloatArray) -> list[FloatArray]:
    eyes = landmarks[_EYES].reshape(2, 6, 3).mean(1)
    return [eye + [side * 3.0, -2.0, 14.0] for eye, side in zip(eyes, (-1, 1), strict=True)]


def _rim(center: FloatArray, size: FloatArray, thick_mm: float) -> Mesh:
    """Return an elliptic tube around a lens in the plane that faces +z."""
    turn, around = (np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (40, 8))
    line = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    out = normalized(line * [*size[::-1], 1.0])
    ring = center + line * [*size, 0.0]
    tube = ring[:, None] + thick_mm * (
        np.cos(around)[None, :, None] * out[:, None] + np.sin(around)[None, :, None] * [0.0, 0.0, 1.0]
    )
    closed = np.concatenate([tube, tube[:1]])
    return closed.reshape(-1, 3), grid_faces(len(turn) + 1, len(around), wrap=True)[:, ::-1]


def lost(
    points: FloatArray, landmarks: FloatArray, features: tuple[str, ...], rng: np.random.Generator
) -> BoolArray:
    """Return which of the measured points (N, 3) the matching did not find."""
    gone = np.zeros(len(points), bool)
    if "glasses" in features:
        size = np.array([rng.uniform(16, 26), rng.uniform(10, 18)])
        for center in _lens_centers(landmarks):
            gone |= (((points - center)[:, :2] / size) ** 2).sum(1) < 1
    if "half face" in features:
        side = rng.choice([-1.0, 1.0])
        gone |= side * (points[:, 0] - landmarks[30, 0]) > rng.uniform(-4, 20)
    if "no neck" in features:
        gone |= points[:, 1] < landmarks[_CHIN, 1] - rng.uniform(-4, 45)
    return gone


def scrap_of(mesh: Mesh, landmarks: FloatArray, place: str, rng: np.random.Generator) -> Mesh:
    """Return the largest connected piece of a head around one of `SCRAPS`, which shows no face.

    It reaches no farther than to 15 % of the landmarks of brows, eyes, nose and mouth.
    """
    vertices, faces = mesh
    anchor = _anchor(landmarks, place, rng)
    distance = np.linalg.norm(vertices - anchor, axis=1)
    reach = rng.uniform(*_SCRAP_REACH_MM) + distance.min()
    features = np.linalg.norm(landmarks[FEATURE_LANDMARKS] - anchor, axis=1)
    reach = min(reach, np.quantile(features, _SCRAP_SHARE) - _SCRAP_MARGIN_MM)
    # However far the surface ends from there, something is left of it.
    reach = max(reach, np.sort(distance[faces].max(1))[_FEWEST_FACES - 1])
    kept = faces[(distance <= reach)[faces].all(1)]
    piece = vertex_components(len(vertices), kept)
    largest = np.bincount(piece[kept[:, 0]]).argmax()
    return compact(vertices, kept[piece[kept[:, 0]] == largest])


def _anchor(landmarks: FloatArray, place: str, rng: np.random.Generator) -> FloatArray:
    """Return the middle (3,) of a scrap, near the head's surface."""
    side = rng.integers(2)
    ear, cheek = landmarks[[0, 16][side]], landmarks[[[2, 31, 48], [14, 35, 54]][side]].mean(0)
    brows, chin = landmarks[_BROWS].mean(0), landmarks[_CHIN]
    outward = np.array([2.0 * side - 1, 0.0, 0.0])
    anchors = {
        "hair": brows + [0, 95, -60] + rng.uniform(-50, 50) * np.array([1.0, 0, 0]),
        "ear": ear + [0, 0, -25] + 10 * outward,
        "cheek": (ear + 2 * cheek) / 3 + 10 * outward,
        "neck": chin + [0, -65, -60],
        "forehead": brows + [0, 50, -5],
        "back": brows + [0, 0, -170] + rng.uniform(-60, 60) * np.array([1.0, 0, 0]),
    }
    if place not in anchors:
        raise ValueError(f"unknown scrap {place!r}, expected one of {SCRAPS}")
    return np.asarray(anchors[place] + rng.normal(scale=8, size=3))
