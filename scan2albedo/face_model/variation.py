"""How people's faces differ from the model: bumps around landmarks, and modes of shape made of them."""

import json
from dataclasses import dataclass
from importlib import resources

import numpy as np

from scan2albedo.core.arrays import FloatArray, Values
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

    landmarks: list[int]
    radius_mm: float
    direction: list[float]
    paired: bool = False
    name: str = ""


def _read(rows: list[Values]) -> tuple[Bump, ...]:
    return tuple(Bump(**row) for row in rows)


_DATA = json.loads(resources.files(__package__).joinpath("data/bumps.json").read_text("utf-8"))
IDENTITY_BUMPS = _read(_DATA["identity"])
ASYMMETRY_BUMPS = _read(_DATA["asymmetry"])
EXPRESSION_BUMPS = {name: _read(rows) for name, rows in _DATA["expressions"].items()}

CAPTURE_BUMPS = _read(_DATA["capture"])
"""Open jaws, beards and glasses, which scans have and identities do not; amount 1 is about a standard
deviation in raw stereo, by eye."""

_EXPRESSION_SD = 0.8
_WAVES = 5
"""Smooth waves over the face, for what no bump describes: how many along each axis."""
_WAVE_MM = 0.45
"""Their height."""
STRETCHES = slice(0, 3)
"""Place of width, height and depth among the `shape_modes`."""

_TWINS = dict(_DATA["twins"])
"""Landmarks of the left half, by those of the right."""


def displacement(bump: Bump, points: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Return the (N, 3) displacement in mm of points (N, 3) by a bump of amount 1."""
    halves = [(bump.landmarks, -1 if bump.paired else 1)]
    if bump.paired:
        halves.append(([_TWINS[k] for k in bump.landmarks], 1))
    moved = np.zeros(points.shape)
    for numbers, side in halves:
        off = points - landmarks[numbers].mean(0)
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
