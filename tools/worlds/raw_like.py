"""Any clean shape as a virtual two-pod scanner sees it."""

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.synthetic.raw_scan import capture, disturbed, random_pose, two_pods
from scan2albedo.synthetic.sitter import (
    HEAD_AXIS_FROM_NOSE_MM,
    Mesh,
    compact,
    crumb_meshes,
    hair_shell,
    join,
    nose_tip,
    shoulder_sheet,
)


def raw_like(
    vertices: ArrayLike,
    faces: ArrayLike,
    seed: int = 0,
    *,
    spacing_mm: float = 2.4,
    noise_mm: float = 0.2,
    holes: int = 6,
    spikes: int = 20,
    crumbs: int = 4,
    hair: bool = True,
    shoulders: bool = True,
    rotation_max_deg: float = 180.0,
    translation_max_mm: float = 300.0,
    scale: float = 1.0,
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
    spacing_mm : float
        Distance of neighbouring samples; 2.4 mm gives about 25,000 vertices with shoulders.
    noise_mm, spikes, rotation_max_deg
        As in `Scanner`.
    holes, crumbs : int
        Holes of 3 to 9 mm radius, loose patches in the air.
    hair, shoulders : bool
        Add a bumpy shell over the scalp, a sheet of clothes.
    translation_max_mm : float
        Of each coordinate.
    scale : float
        Unit of the returned scan: 1 millimetres, 0.1 centimetres, 0.001 metres.
    """
    rng = np.random.default_rng(seed)
    shape, index = np.asarray(vertices, float), np.asarray(faces, np.int64)
    parts = [(shape, index)]
    if hair:
        parts.append(hair_shell(shape, index, rng))
    if shoulders:
        parts.append(shoulder_sheet(shape, rng))
    scene = join(parts)
    center = (scene[0].min(0) + scene[0].max(0)) / 2
    pods = two_pods(center, reach_mm=1.3 * float(np.linalg.norm(scene[0] - center, axis=1).max()))
    axis = nose_tip(shape) + HEAD_AXIS_FROM_NOSE_MM
    measured = capture(*scene, pods, spacing_mm=spacing_mm, rng=rng, axis_mm=axis)
    points = disturbed(measured.vertices, measured.faces, rng, noise_mm, spikes)
    centers = points[rng.choice(len(points), holes)]
    mesh = with_holes((points, measured.faces), centers, rng.uniform(3, 9, holes))
    mesh = join([mesh, *crumb_meshes(mesh[0], rng, crumbs)])
    pose = random_pose(rng, rotation_max_deg, translation_max_mm)
    scan_from_shape = np.diag([scale] * 3 + [1.0]) @ pose
    scan = RawScan(transform_points(scan_from_shape, mesh[0]), mesh[1], name=f"raw-like {seed}")
    return scan, scan_from_shape


def with_holes(mesh: Mesh, centers: FloatArray, radii_mm: FloatArray) -> Mesh:
    """Return the mesh without the faces whose corners lie inside one of the balls."""
    vertices, faces = mesh
    inside = np.zeros(len(vertices), bool)
    for center, radius in zip(centers, radii_mm, strict=True):
        inside |= np.linalg.norm(vertices - center, axis=1) < radius
    return compact(vertices, faces[~inside[faces].any(1)])
