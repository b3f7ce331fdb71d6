"""Raw passive stereo of a synthetic person: coarse, noisy, in pieces, with much that is no face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.synthetic.face_shape import EXPRESSION_BUMPS, Expression
from scan2albedo.synthetic.head import (
    HEAD_AXIS_FROM_NOSE_MM,
    Mesh,
    compact,
    crumbs,
    grid_faces,
    join,
    nose_tip,
    with_holes,
)
from scan2albedo.synthetic.raw_like import disturbed, random_pose
from scan2albedo.synthetic.scanner import capture, two_pods
from scan2albedo.synthetic.sitter import Sitter, sit_down
from scan2albedo.synthetic.textures import smoothstep

FEATURES = ("glasses", "open mouth", "beard", "fringe", "half face", "no neck")
"""What may hide or change a face, and the `_CHANCES` of each."""
_CHANCES = (0.3, 0.25, 0.2, 0.25, 0.1, 0.4)
_CENTER_FROM_NOSE_MM = np.array([0.0, -15.0, -70.0])
_EYES, _MOUTH, _CHIN, _BROWS = slice(36, 48), slice(48, 68), 8, slice(17, 27)
_FARTHEST_MM, _NEAREST_STRAY_MM = 1300.0, 200.0
_PATCH = 5
"""Rows and columns of vertices of a stray patch."""


@dataclass(frozen=True)
class StereoScanOptions:
    """Ranges from which each scan draws, as measured on raw stereo scans of real faces."""

    spacing_mm: tuple[float, float] = (3.5, 5.5)
    """Distance of neighbouring vertices."""
    noise_mm: tuple[float, float] = (0.4, 2.0)
    """Standard deviation along the normals."""
    stray: tuple[float, float] = (0.005, 0.2)
    """Part of the vertices that lies 200 mm to 1.3 m away; drawn by its logarithm."""
    pieces: tuple[int, int] = (9, 45)
    """Loose pieces, the face's own among them."""
    reach_mm: tuple[float, float] = (85.0, 170.0)
    """Distance from the middle of the face to which the head is measured."""
    holes: tuple[int, int] = (3, 20)
    """Holes of 3 to 12 mm radius."""
    features: tuple[str, ...] | None = None
    """Names from `FEATURES`; drawn when None."""


@dataclass(frozen=True)
class StereoTruth:
    """What is known about a scan."""

    model_from_scan: FloatArray
    """(4, 4): true pose: maps scan points into the model's frame, mm."""
    landmarks: FloatArray
    """(68, 3): true landmarks in the model's frame, mm; of a shut mouth, whatever it does."""
    expression: str
    features: tuple[str, ...]
    """`expression`, `features`: what was drawn, or asked for."""


def stereo_scan(
    seed: int = 0,
    *,
    model: AnnotatedFaceModel | None = None,
    options: StereoScanOptions = StereoScanOptions(),
) -> tuple[RawScan, StereoTruth]:
    """Return the untextured scan of a random person with a random expression, in any pose, and its truth.

    Two pods see the head. Stereo loses what is smooth, glassy or thin: strips behind glasses are missing, and
    their rims are loose shreds; an open mouth is a pit. Mismatches are patches along the line of sight, up to
    1.3 m off. ValueError for an unknown feature.

    Parameters
    ----------
    seed : int
        Of the person and everything else; same seed, same scan.
    model : AnnotatedFaceModel, optional
        The default model when omitted; it needs landmarks.
    options : StereoScanOptions
    """
    rng = np.random.default_rng([seed, 23])
    features = _features(options.features, rng)
    names: list[Expression] = sorted(EXPRESSION_BUMPS)  # type: ignore[arg-type]
    expression = names[rng.integers(len(names))]
    sitter = sit_down(
        seed,
        expression=expression,
        model=model or AnnotatedFaceModel.default(),
        expression_strength=rng.uniform(0.5, 1.5),
    )
    vertices = _shaped(sitter, features, rng)
    tip = nose_tip(sitter.face.vertices)
    parts = [(vertices, sitter.faces), *_worn(sitter, features, rng)]
    measured = capture(
        *join(parts),
        two_pods(tip + _CENTER_FROM_NOSE_MM, reach_mm=205.0),
        spacing_mm=rng.uniform(*options.spacing_mm),
        rng=rng,
        axis_mm=tip + HEAD_AXIS_FROM_NOSE_MM,
    )
    points = disturbed(measured.vertices, measured.faces, rng, rng.uniform(*options.noise_mm), 10)
    lost = _lost(points, sitter.face.landmarks, features, rng)
    middle = sitter.face.landmarks[17:].mean(0) + rng.normal(scale=8, size=3)
    lost |= np.linalg.norm(points - middle, axis=1) > rng.uniform(*options.reach_mm)
    mesh = compact(points, measured.faces[~lost[measured.faces].any(1)])
    count = int(rng.integers(*options.holes, endpoint=True))
    mesh = with_holes(mesh, mesh[0][rng.choice(len(mesh[0]), count)], rng.uniform(3, 12, count))
    loose = crumbs(mesh[0], rng, int(rng.integers(*options.pieces, endpoint=True)) - 1)
    share = float(np.exp(rng.uniform(*np.log(options.stray))))
    posed, faces = join([mesh, *loose, *_stray(mesh[0], share, rng)])
    pose = random_pose(rng, 180.0, 300.0)
    scan = RawScan(transform_points(pose, posed), faces, name=f"stereo-{seed}")
    return scan, StereoTruth(invert_rigid(pose), sitter.face.landmarks, expression, features)


def _features(wanted: tuple[str, ...] | None, rng: np.random.Generator) -> tuple[str, ...]:
    drawn = rng.uniform(size=len(FEATURES)) < _CHANCES
    if wanted is None:
        return tuple(name for name, there in zip(FEATURES, drawn, strict=True) if there)
    unknown = sorted(set(wanted) - set(FEATURES))
    if unknown:
        raise ValueError(f"unknown features {unknown}, expected some of {FEATURES}")
    return tuple(wanted)


def _shaped(sitter: Sitter, features: tuple[str, ...], rng: np.random.Generator) -> FloatArray:
    """Return the sitter's vertices (V, 3) with a jaw that is down, and a beard that stands off."""
    landmarks, vertices = sitter.face.landmarks, sitter.vertices.copy()
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
        vertices += (rng.uniform(3, 12) * lower * tufts)[:, None] * vertex_normals(vertices, sitter.faces)
    return vertices


def _near(points: FloatArray, center: FloatArray, radius_mm: float) -> FloatArray:
    """Return (N,) 1 at a centre (3,), falling to 0 over its surroundings."""
    return np.exp(-0.5 * (((points - center) / radius_mm) ** 2).sum(1) ** 2)


def _worn(sitter: Sitter, features: tuple[str, ...], rng: np.random.Generator) -> list[Mesh]:
    """Return the meshes of hair over the forehead and of the rims of glasses."""
    parts: list[Mesh] = []
    face, landmarks = sitter.face, sitter.face.landmarks
    if "fringe" in features:
        brow = landmarks[_BROWS, 1].mean()
        top = face.vertices[:, 1].max()
        x = face.vertices[:, 0]
        ragged = 4 * np.sin(x / rng.uniform(3, 6)) + rng.uniform(-0.3, 0.3) * x
        above = face.vertices[:, 1] > top - rng.uniform(0.3, 0.75) * (top - brow) + ragged
        locks = rng.uniform(3, 9) * (1 + 0.2 * np.sin(x / 2.2))
        parts.append(
            compact(face.vertices + locks[:, None] * face.normals, face.faces[above[face.faces].all(1)])
        )
    if "glasses" in features:
        size = np.array([rng.uniform(22, 30), rng.uniform(16, 24)])
        parts += [_rim(center, size, rng.uniform(1.5, 4)) for center in _lens_centers(landmarks)]
    return parts


def _lens_centers(landmarks: FloatArray) -> list[FloatArray]:
    eyes = landmarks[_EYES].reshape(2, 6, 3).mean(1)
    return [eye + [3 * np.sign(eye[0]), -2.0, 14.0] for eye in eyes]


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


def _lost(
    points: FloatArray, landmarks: FloatArray, features: tuple[str, ...], rng: np.random.Generator
) -> BoolArray:
    """Return which of the measured points (N, 3) the matching did not find."""
    lost = np.zeros(len(points), bool)
    if "glasses" in features:
        size = np.array([rng.uniform(16, 26), rng.uniform(10, 18)])
        for center in _lens_centers(landmarks):
            lost |= (((points - center)[:, :2] / size) ** 2).sum(1) < 1
    if "half face" in features:
        side = rng.choice([-1.0, 1.0])
        lost |= side * (points[:, 0] - landmarks[30, 0]) > rng.uniform(-4, 20)
    if "no neck" in features:
        lost |= points[:, 1] < landmarks[_CHIN, 1] - rng.uniform(-4, 45)
    return lost


def _stray(vertices: FloatArray, share: float, rng: np.random.Generator) -> list[Mesh]:
    """Return patches that hold `share` of all vertices, far in front of the face or behind it."""
    center, patches = vertices.mean(0), []
    count = max(1, round(share * len(vertices) / (1 - share) / _PATCH**2))
    faces = grid_faces(_PATCH, _PATCH)
    for _ in range(count):
        sight = normalized(np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3), 1.0]))
        away = rng.choice([-1, 1], p=[0.7, 0.3]) * rng.uniform(_NEAREST_STRAY_MM, _FARTHEST_MM)
        spread = rng.normal(scale=rng.uniform(3, 12), size=(_PATCH**2, 3))
        patches.append((center + away * sight + rng.normal(scale=50, size=3) + spread, faces))
    return patches
