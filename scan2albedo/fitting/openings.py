"""Holes of a scan between lids and lips: scanners lose what is wet, and so show where eyes and mouth open."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import LANDMARK_LEVELS
from scan2albedo.fitting.landmark_pull import SHOWN_BY_HOLE, LandmarkPull
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.mesh import edges_with_faces

EYES = (tuple(range(36, 42)), tuple(range(42, 48)))
"""iBUG-68, the subject's right eye first."""
INNER_LIPS = tuple(range(60, 68))
_REACH_MM, _ASIDE_MM, _LEVEL_MM = 25.0, 4.0, 5.0
"""A registered face has its eyes, and the middle of its lips, this near to the model's; the middle between
both eyes, or between a mouth's ends, is this near to its midline, and they stand this level."""
_EYE_MM, _MOUTH_MM = ((16.0, 36.0), (4.0, 25.0)), ((20.0, 75.0), (4.0, 50.0))
"""Width and height of holes that may be an opening, with what a scanner loses around it."""
_APART_MM, _ALIKE = (50.0, 78.0), (1.3, 1.8)
"""Between the middles of people's eyes. One eye's hole is at most so much wider and higher than the other's:
else more is missing than an eye."""
_MIDDLE_MM, _END_MM = 1.5, 3.0
"""Standard deviations of the middle of a hole and its ends from those of the opening."""


def openings(scan: ScanSurface, model: AnnotatedSurface) -> LandmarkPull | None:
    """Return the pull of lids and lips to the holes that they surround; None where the scan has none.

    The scan lies in the model's frame, registered. Two holes of the size of eyes, level and as far apart as
    people's, near the model's, are eyes; one of the size of a mouth, on the midline near the model's, is one.
    """
    landmarks = model.landmarks
    if landmarks is None or model.landmark_points is None or not scan.boundary.any():
        return None
    # Edges that hang together: where a border touches itself, loops would cut a mouth in two. Those with an
    # odd number of faces close, even where lips grew together in an edge of three.
    edges, faces_around = edges_with_faces(scan.faces)
    edges = edges[faces_around % 2 == 1]
    links = sparse.coo_matrix((np.ones(len(edges)), edges.T), (len(scan.vertices),) * 2)
    label = connected_components(links, directed=False)[1][edges[:, 0]]
    # Of each hole its middle, its ends, the subject's right and left, and its width and height.
    middles, ends, sizes = [], [], []
    for one in np.unique(label):
        border = scan.vertices[edges[label == one]]
        lengths, points = np.linalg.norm(border[:, 1] - border[:, 0], axis=1), border.reshape(-1, 3)
        middles.append(lengths @ border.mean(1) / max(float(lengths.sum()), 1e-12))
        ends.append(points[[np.argmin(points[:, 0]), np.argmax(points[:, 0])]])
        sizes.append(np.ptp(points, axis=0)[:2])
    middle, end, size = np.reshape(middles, (-1, 3)), np.reshape(ends, (-1, 2, 3)), np.reshape(sizes, (-1, 2))

    def holes(ranges: tuple[tuple[float, float], tuple[float, float]], place: FloatArray) -> list[int]:
        """Return those whose width and height lie in their ranges, and the middle near a place."""
        low, high = np.array(ranges).T
        near = np.linalg.norm(middle - place, axis=1) < _REACH_MM
        return np.flatnonzero(near & ((low < size) & (size < high)).all(1)).tolist()

    right_eye, left_eye = (landmarks[list(eye)].mean(0) for eye in EYES)
    pairs = []
    for right, left in product(holes(_EYE_MM, right_eye), holes(_EYE_MM, left_eye)):
        apart, up, _ = middle[left] - middle[right]
        aside = (middle[right] + middle[left])[0] / 2 - (right_eye + left_eye)[0] / 2
        alike = np.maximum(size[right], size[left]) < _ALIKE * np.minimum(size[right], size[left])
        level = np.hypot(up / _LEVEL_MM, aside / _ASIDE_MM) < 1
        if _APART_MM[0] < apart < _APART_MM[1] and level and alike.all():
            off = np.linalg.norm([middle[right] - right_eye, middle[left] - left_eye], axis=1).sum()
            pairs.append((float(off), right, left))
    lips = landmarks[list(INNER_LIPS)].mean(0)
    aside, tilt = np.abs(end[:, :, 0].mean(1) - lips[0]), np.abs(np.ptp(end[:, :, 1], axis=1))
    mouths = [k for k in holes(_MOUTH_MM, lips) if aside[k] < _ASIDE_MM and tilt[k] < _LEVEL_MM]
    # Of each opening the landmarks around it, the numbers of its two ends, and its hole.
    found = []
    if pairs:
        both = min(pairs, key=lambda pair: pair[0])[1:]
        found += [(eye, (eye[0], eye[3]), hole) for eye, hole in zip(EYES, both, strict=True)]
    if mouths:
        found.append(
            (INNER_LIPS, (INNER_LIPS[0], INNER_LIPS[4]), max(mouths, key=lambda hole: size[hole, 0]))
        )
    if not found:
        return None
    weights = np.zeros((3 * len(found), 68))
    for row, (around, (first, last), _) in enumerate(found):
        weights[3 * row, list(around)] = 1 / len(around)
        weights[3 * row + 1, first] = weights[3 * row + 2, last] = 1.0
    every = model.subdivision(LANDMARK_LEVELS).points_matrix(model.landmark_points)
    return LandmarkPull(
        numbers=np.full(len(weights), SHOWN_BY_HOLE),
        matrix=(sparse.csr_matrix(weights) @ every).tocsr(),
        targets=np.vstack([[middle[hole], *end[hole]] for _, _, hole in found]),
        sigma_mm=np.tile([_MIDDLE_MM, _END_MM, _END_MM], len(found)),
        wrong_mm=np.full(len(weights), 2 * _REACH_MM),
        # The border of a hole may lie deep between lids or lips.
        axes=np.ones((len(weights), 3)) * (1.0, 1.0, 0.0),
        still=np.repeat([around != INNER_LIPS for around, _, _ in found], 3),
    )
