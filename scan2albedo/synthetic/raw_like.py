"""Make any clean face shape look like a raw scan, for tests and benchmarks of registration and fitting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rigid import compose, random_rotation, rotation_from_vector, transform_points
from scan2albedo.synthetic.head import (
    HEAD_AXIS_FROM_NOSE_MM,
    crumbs,
    hair_shell,
    join,
    nose_tip,
    shoulder_sheet,
    with_holes,
)
from scan2albedo.synthetic.scanner import capture, two_pods


@dataclass(frozen=True)
class RawLikeOptions:
    """How the scan differs from the clean face."""

    spacing_mm: float = 2.4
    """Distance of neighbouring samples on the head; 2.4 mm gives about 25,000 vertices with shoulders."""
    noise_mm: float = 0.2
    """Standard deviation of the noise along the normals."""
    holes: int = 6
    """Holes of 3 to 9 mm radius."""
    spikes: int = 20
    """Vertices thrown 3 to 15 mm off the surface."""
    crumbs: int = 4
    """Loose patches of a few triangles floating near the surface."""
    hair: bool = True
    shoulders: bool = True
    """`hair`, `shoulders`: add a bumpy shell over the scalp and a sheet of clothes."""
    rotation_max_deg: float = 180.0
    """Pose: a uniformly random rotation when 180, else about a random axis by at most this angle."""
    translation_max_mm: float = 300.0
    """Pose: each coordinate uniform in +- this."""
    scale: float = 1.0
    """Unit of the returned scan: 1 millimetres, 0.1 centimetres, 0.001 metres."""


def raw_like(
    vertices: ArrayLike, faces: ArrayLike, seed: int = 0, *, options: RawLikeOptions | None = None
) -> tuple[RawScan, FloatArray]:
    """Return a clean face as a virtual two-pod scanner sees it, untextured, and `scan_from_shape` (4, 4).

    The scan is resampled, noisy, with holes and clutter, and in the frame and unit that `scan_from_shape`
    maps the clean shape into.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        Millimetres; the face looks along +z with +y up (only the pods' side of it is measured).
    faces : (F, 3) array_like of int
    seed : int
        Same seed, same scan.
    options : RawLikeOptions, optional
    """
    settings, rng = options or RawLikeOptions(), np.random.default_rng(seed)
    shape, index = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    parts = [(shape, index)]
    if settings.hair:
        parts.append(hair_shell(shape, index, rng))
    if settings.shoulders:
        parts.append(shoulder_sheet(shape, rng))
    scene = join(parts)
    shape_center = (scene[0].min(0) + scene[0].max(0)) / 2
    reach = 1.3 * float(np.linalg.norm(scene[0] - shape_center, axis=1).max())
    measured = capture(
        *scene,
        two_pods(shape_center, reach_mm=reach),
        spacing_mm=settings.spacing_mm,
        rng=rng,
        axis_mm=nose_tip(shape) + HEAD_AXIS_FROM_NOSE_MM,
    )
    points = disturbed(measured.vertices, measured.faces, rng, settings.noise_mm, settings.spikes)
    centers = points[rng.choice(len(points), settings.holes)]
    mesh = with_holes((points, measured.faces), centers, rng.uniform(3, 9, settings.holes))
    mesh = join([mesh, *crumbs(mesh[0], rng, settings.crumbs)])
    pose = random_pose(rng, settings.rotation_max_deg, settings.translation_max_mm)
    scan_from_shape = np.diag([settings.scale] * 3 + [1.0]) @ pose
    return RawScan(
        transform_points(scan_from_shape, mesh[0]), mesh[1], name=f"raw-like {seed}"
    ), scan_from_shape


def disturbed(
    vertices: FloatArray, faces: IntArray, rng: np.random.Generator, noise_mm: float, spikes: int
) -> FloatArray:
    """Return the vertices with Gaussian noise along their normals and a few thrown far off."""
    offset = rng.normal(scale=noise_mm, size=len(vertices))
    thrown = rng.choice(len(vertices), spikes, replace=False)
    offset[thrown] += rng.uniform(3, 15, spikes) * rng.choice([-1, 1], spikes)
    return vertices + offset[:, None] * vertex_normals(vertices, faces)


def random_pose(rng: np.random.Generator, rotation_max_deg: float, translation_max_mm: float) -> FloatArray:
    """Return a random rigid transform (4, 4)."""
    if rotation_max_deg >= 180:
        rotation = random_rotation(rng)
    else:
        axis = rng.normal(size=3)
        angle = np.deg2rad(rotation_max_deg) * rng.uniform()
        rotation = rotation_from_vector(axis / np.linalg.norm(axis) * angle)
    return compose(rotation, rng.uniform(-1, 1, 3) * translation_max_mm)
