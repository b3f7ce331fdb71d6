"""Raw passive stereo of a synthetic person: coarse, noisy, in pieces, with much that is no face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.face_model.variation import EXPRESSION_BUMPS
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_from_vector, transform_points
from scan2albedo.synthetic.face_shape import Expression
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
from scan2albedo.synthetic.sitter import sit_down
from scan2albedo.synthetic.stereo_features import Head, drawn_features, lost, scrap_of, shaped, worn

_CENTER_FROM_NOSE_MM = np.array([0.0, -15.0, -70.0])
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
    """Names from `stereo_features.FEATURES`; drawn when None."""
    scrap: str | None = None
    """One of `stereo_features.SCRAPS`: of the head there is only a scrap, which shows no face."""


@dataclass(frozen=True)
class StereoTruth:
    """What is known about a scan."""

    model_from_scan: FloatArray
    """(4, 4): true pose: maps scan points into the model's frame, or that of the given shape, mm."""
    landmarks: FloatArray
    """(68, 3): true landmarks in that frame, mm; of a shut mouth, whatever it does."""
    expression: str
    """The one drawn; empty where the shape was given."""
    features: tuple[str, ...]
    """What was drawn, or asked for."""


def stereo_scan(
    seed: int = 0,
    *,
    capture_seed: int | None = None,
    model: AnnotatedSurface | None = None,
    options: StereoScanOptions = StereoScanOptions(),
) -> tuple[RawScan, StereoTruth]:
    """Return the untextured scan of a random person with a random expression, in any pose, and its truth.

    Two pods see the head. Stereo loses what is smooth, glassy or thin: strips behind glasses are missing, and
    their rims are loose shreds; an open mouth is a pit. Mismatches are patches along the line of sight, up to
    1.3 m off. ValueError for an unknown feature or scrap, and where holes leave nothing.

    Parameters
    ----------
    seed : int
        Of the person and everything else; same seed, same scan.
    capture_seed : int, optional
        Of what differs between two scans of one shape: samples, noise, holes, strays, reach and pose.
    model : AnnotatedFaceModel, optional
        The default model when omitted; it needs landmarks.
    options : StereoScanOptions
    """
    rng = np.random.default_rng([seed, 23])
    features = drawn_features(options.features, rng)
    names: list[Expression] = sorted(EXPRESSION_BUMPS)  # type: ignore[arg-type]
    expression = names[rng.integers(len(names))]
    sitter = sit_down(
        seed,
        expression=expression,
        model=model or default_model(),
        expression_strength=rng.uniform(0.5, 1.5),
    )
    face = sitter.face
    head = Head(sitter.vertices, sitter.faces, face.landmarks, (face.vertices, face.faces), face.normals)
    scan, pose = _scanned(head, features, rng, (seed, capture_seed), options)
    return scan, StereoTruth(invert_rigid(pose), face.landmarks, expression, features)


def stereo_scan_of(
    vertices: ArrayLike,
    faces: ArrayLike,
    landmarks: ArrayLike,
    seed: int = 0,
    *,
    capture_seed: int | None = None,
    options: StereoScanOptions = StereoScanOptions(),
) -> tuple[RawScan, StereoTruth]:
    """Return the untextured scan of a given head as `stereo_scan` makes it, and its truth.

    Features drawn or asked for change the head.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        Whole head, mm, anywhere; it looks along +z with +y up. Hair and clothes may be loose parts.
    faces : (F, 3) array_like of int
    landmarks : (68, 3) array_like of float
        Of the head, iBUG-68 order.
    seed : int
        Same seed, same features and scan.
    capture_seed : int, optional
        See `stereo_scan`.
    options : StereoScanOptions

    Raises
    ------
    ValueError
        For landmarks of another shape, an unknown feature or scrap, and where holes leave nothing.
    """
    points = np.asarray(landmarks, np.float64)
    if points.shape != (68, 3):
        raise ValueError(f"landmarks have shape {points.shape}, expected (68, 3)")
    rng = np.random.default_rng([seed, 29])
    features = drawn_features(options.features, rng)
    head = Head.of(np.asarray(vertices, np.float64), np.asarray(faces, np.int64), points)
    scan, pose = _scanned(head, features, rng, (seed, capture_seed), options)
    return scan, StereoTruth(invert_rigid(pose), points, "", features)


def _scanned(
    head: Head,
    features: tuple[str, ...],
    rng: np.random.Generator,
    seeds: tuple[int, int | None],
    options: StereoScanOptions,
) -> tuple[RawScan, FloatArray]:
    """Return the scan of a head with features, and `scan_from_head` (4, 4).

    `rng` draws the shape and, where the capture has no seed of its own in `seeds`, the capture.
    """
    tip = nose_tip(head.front[0])
    parts = [(shaped(head, features, rng), head.faces), *worn(head, features, rng)]
    seed, capture_seed = seeds
    name = f"stereo-{seed}"
    if capture_seed is not None:
        name += f"-{capture_seed}"
        rng = np.random.default_rng([seed, capture_seed, 31])
    mesh = _measured(join(parts), tip, options, rng)
    gone = lost(mesh[0], head.landmarks, features, rng)
    if options.scrap is None:
        middle = head.landmarks[17:].mean(0) + rng.normal(scale=8, size=3)
        gone |= np.linalg.norm(mesh[0] - middle, axis=1) > rng.uniform(*options.reach_mm)
    mesh = compact(mesh[0], mesh[1][~gone[mesh[1]].any(1)])
    if options.scrap is not None:
        mesh = scrap_of(mesh, head.landmarks, options.scrap, rng)
    else:
        count = int(rng.integers(*options.holes, endpoint=True))
        mesh = with_holes(mesh, mesh[0][rng.choice(len(mesh[0]), count)], rng.uniform(3, 12, count))
    if len(mesh[1]) == 0:
        raise ValueError(f"nothing is left of the head: fewer holes or more reach are needed, not {options}")
    loose = crumbs(mesh[0], rng, int(rng.integers(*options.pieces, endpoint=True)) - 1)
    share = float(np.exp(rng.uniform(*np.log(options.stray))))
    posed, faces = join([mesh, *loose, *_stray(mesh[0], share, rng)])
    pose = random_pose(rng, 180.0, 300.0)
    return RawScan(transform_points(pose, posed), faces, name=name), pose


def _measured(mesh: Mesh, tip: FloatArray, options: StereoScanOptions, rng: np.random.Generator) -> Mesh:
    """Return what two pods before the head measure of it; behind it, for its back."""
    axis = tip + HEAD_AXIS_FROM_NOSE_MM
    turn = np.eye(4)
    if options.scrap == "back":
        rotation = rotation_from_vector([0.0, np.pi + rng.uniform(-0.5, 0.5), 0.0])
        turn = compose(rotation, axis - rotation @ axis)
    measured = capture(
        transform_points(turn, mesh[0]),
        mesh[1],
        two_pods(tip + _CENTER_FROM_NOSE_MM, reach_mm=205.0),
        spacing_mm=rng.uniform(*options.spacing_mm),
        rng=rng,
        axis_mm=axis,
    )
    noise_mm = rng.uniform(*options.noise_mm)
    points = disturbed(measured.vertices, measured.faces, rng, noise_mm, 10)
    return transform_points(invert_rigid(turn), points), measured.faces


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
