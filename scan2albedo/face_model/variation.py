"""How people's faces differ from the model: bumps around landmarks, and modes of shape made of them."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model.annotation import AnnotatedSurface
from scan2albedo.geometry.mesh import vertex_normals

STRETCH_SD = np.array([0.035, 0.035, 0.045])
"""Standard deviation of the head's width, height and depth, relative."""


@dataclass(frozen=True)
class Bump:
    """A Gaussian displacement around the mean of some landmarks (iBUG-68 numbers, right half or midline).

    `radius_mm` is the Gaussian's standard deviation, `direction` its displacement in mm at the centre for
    amount 1, x > 0 away from the midline; `paired` repeats it mirrored on the left half.
    """

    landmarks: tuple[int, ...]
    radius_mm: float
    direction: tuple[float, float, float]
    paired: bool = False


IDENTITY_BUMPS = (
    Bump((30, 33), 13, (0, -1.0, 2.5)),  # nose protrusion
    Bump((30, 33), 15, (0, -2.5, 0)),  # nose length
    Bump((27, 28), 11, (0, 0, 1.8)),  # nose bridge
    Bump((31,), 9, (1.6, 0, 0), paired=True),  # nose width
    Bump((19,), 18, (0, 0.5, 1.8), paired=True),  # brow ridge
    Bump((37, 40), 13, (0, 0, 1.2), paired=True),  # eye depth
    Bump((36,), 10, (1.2, 1.0, 0), paired=True),  # outer eye corner
    Bump((2, 31, 36), 20, (1.2, 0.8, 2.2), paired=True),  # cheekbone
    Bump((3, 48), 20, (1.5, 0, 1.8), paired=True),  # cheek fullness
    Bump((4,), 30, (3.5, 0, 0), paired=True),  # jaw width
    Bump((8,), 22, (0, 0, 2.8)),  # chin protrusion
    Bump((7, 8, 9), 25, (0, -3.0, 0)),  # chin length
    Bump((51, 57), 9, (0, 0, 1.3)),  # lip fullness
    Bump((48,), 11, (2.0, 0.3, -0.5), paired=True),  # mouth width
    Bump((19, 24), 35, (0, 0, 1.5)),  # forehead slope
)
ASYMMETRY_BUMPS = (
    Bump((30,), 16, (0.9, 0, 0)),
    Bump((48,), 16, (0, 0.9, 0.3)),
    Bump((19,), 16, (0, 0.8, 0.4)),
    Bump((12,), 30, (0.6, 0.5, 0.6)),
)
EXPRESSION_BUMPS: dict[str, tuple[Bump, ...]] = {
    "neutral": (),
    "smile": (
        Bump((48,), 12, (5.5, 5.0, -3.0), paired=True),
        Bump((2, 31, 36), 16, (0.5, 2.5, 3.0), paired=True),
        Bump((51, 57), 9, (0, 0.5, -1.5)),
    ),
    "frown": (
        Bump((21,), 11, (-2.5, -4.5, 0.8), paired=True),
        Bump((48,), 12, (0.5, -3.5, -0.5), paired=True),
        Bump((57,), 10, (0, 1.5, 1.0)),
    ),
    "pout": (Bump((48,), 11, (-5.0, 0, 2.0), paired=True), Bump((51, 57), 12, (0, 0, 5.0))),
    "puff": (Bump((3, 48), 18, (4.5, 0, 6.0), paired=True), Bump((48,), 10, (-1.5, 0, 1.0), paired=True)),
    "surprise": (Bump((19,), 16, (0, 5.5, 0.8), paired=True), Bump((8,), 28, (0, -3.0, -0.5))),
}

CAPTURE_BUMPS = (
    Bump((8, 57), 26, (0, -9.0, -3.0)),  # jaw down
    Bump((6, 8, 10), 30, (0, -9.0, -3.0)),
    Bump((62, 66), 11, (0, 0, -6.0)),  # the pit of an open mouth
    Bump((57,), 9, (0, -4.0, 0)),
    Bump((5,), 26, (1.5, 0, 3.0), paired=True),  # beard
    Bump((8,), 28, (0, 0, 4.0)),
    Bump((37, 40), 11, (0, 0, 2.5), paired=True),  # what glasses leave of the eyes
)
"""Open jaws, beards and glasses, which scans have and identities do not; amount 1 is about a standard
deviation in raw stereo, by eye."""

_EXPRESSION_SD = 0.8
_WAVES = 5
"""Smooth waves over the face, for what no bump describes: how many along each axis."""
_WAVE_MM = 0.45
"""Their height."""
STRETCHES = slice(0, 3)
"""Place of width, height and depth among the `shape_modes`."""

# Landmark k of the right half and its twin on the left.
_MIRRORED = {2: 14, 3: 13, 4: 12, 5: 11, 19: 24, 21: 22, 31: 35, 36: 45, 37: 44, 40: 47, 48: 54}


def displacement(bump: Bump, points: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Return the (N, 3) displacement in mm of points (N, 3) by a bump of amount 1."""
    halves = [(bump.landmarks, -1 if bump.paired else 1)]
    if bump.paired:
        halves.append((tuple(_MIRRORED[k] for k in bump.landmarks), 1))
    moved = np.zeros(points.shape)
    for numbers, side in halves:
        off = points - landmarks[list(numbers)].mean(0)
        high = np.exp(-np.sum(off**2, axis=1) / (2 * bump.radius_mm**2))
        moved += high[:, None] * (np.array(bump.direction) * [side, 1, 1])
    return moved


def similarity_modes(points: FloatArray) -> FloatArray:
    """Return (7, N, 3): small motions along and about the axes, and the growth, of points (N, 3)."""
    moves = [np.broadcast_to(unit, points.shape) for unit in np.eye(3)]
    return np.array([*moves, *(np.cross(unit, points) for unit in np.eye(3)), points])


def identity_modes(model: AnnotatedSurface) -> FloatArray:
    """Return (K, C, 3) displacements in mm of control points, each one standard deviation among people.

    The head's width, height and depth, and bumps, which a model without landmarks has not.
    """
    rest = model.control_vertices
    modes = [sd * rest * axis for sd, axis in zip(STRETCH_SD, np.eye(3), strict=True)]
    if model.landmarks is not None:
        modes += [displacement(b, rest, model.landmarks) for b in IDENTITY_BUMPS + ASYMMETRY_BUMPS]
    return np.array(modes)


def expression_variance(model: AnnotatedSurface) -> FloatArray:
    """Return (C,) mm^2 along an axis by which expressions move control points; 0 without landmarks.

    The mean over the EXPRESSION_BUMPS, the neutral face among them, and an open jaw, each as likely.
    """
    rest, faces = model.control_vertices, (*EXPRESSION_BUMPS.values(), CAPTURE_BUMPS[:1])
    if model.landmarks is None:
        return np.zeros(len(rest))
    none, landmarks = np.zeros_like(rest), model.landmarks
    moved = [sum((_EXPRESSION_SD * displacement(b, rest, landmarks) for b in bumps), none) for bumps in faces]
    return np.mean(np.square(moved), axis=(0, 2))


def shape_modes(model: AnnotatedSurface, weights: FloatArray) -> FloatArray:
    """Return (K, C, 3) displacements in mm of the model's control points, each one standard deviation.

    The head's width, height and depth, bumps of identities, expressions and captures, and smooth waves. None
    moves, turns or scales the control points as a whole, weighed by `weights` (C,). Bumps need landmarks.
    """
    rest, modes = model.control_vertices, list(identity_modes(model))
    if model.landmarks is not None:
        expressions = [bump for bumps in EXPRESSION_BUMPS.values() for bump in bumps]
        for bump, weight in [(b, 1.0) for b in CAPTURE_BUMPS] + [(b, _EXPRESSION_SD) for b in expressions]:
            modes.append(weight * displacement(bump, rest, model.landmarks))
    normals = vertex_normals(rest, model.control_faces)
    low, high = rest.min(0), rest.max(0)
    across, along = (np.pi * ((rest - low) / (high - low))[:, :2]).T
    for k in range(_WAVES):
        for m in range(_WAVES):
            modes += [_WAVE_MM * (np.cos(k * across) * np.cos(m * along))[:, None] * normals] if k + m else []
    # Less the motion, turn and growth nearest to each.
    basis = similarity_modes(rest - weights @ rest / weights.sum()).reshape(7, -1)
    flat = np.array(modes).reshape(len(modes), -1)
    weighted = basis * np.repeat(weights, 3)
    return (flat - flat @ weighted.T @ np.linalg.inv(weighted @ basis.T) @ basis).reshape(-1, *rest.shape)
