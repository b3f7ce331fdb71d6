"""Raw scans with known truth: of a synthetic person with flash photographs, or of any clean shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.point_light import PointLight
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.synthetic.face_shape import Expression, face_geometry_image
from scan2albedo.synthetic.head import (
    HEAD_AXIS_FROM_NOSE_MM,
    crumb_meshes,
    hair_shell,
    join,
    nose_tip,
    shoulder_sheet,
    with_holes,
)
from scan2albedo.synthetic.renderer import Material
from scan2albedo.synthetic.room_light import Room
from scan2albedo.synthetic.scanner import (
    HEAD_FROM_NOSE_MM,
    HEAD_REACH_MM,
    Pod,
    RangeMesh,
    Scanner,
    capture,
    disturbed,
    flash_pictures,
    random_pose,
    two_pods,
)
from scan2albedo.synthetic.scenes import light_at, texel_coordinates
from scan2albedo.synthetic.sitter import Sitter, sit_down

_PICTURE_NOISE = 0.004
"""Standard deviation, white = 1: that of a good camera's 8-bit pictures."""


@dataclass(frozen=True)
class SyntheticTruth:
    """Everything about a synthetic scan that the pipeline estimates."""

    model_from_scan: FloatArray
    """(4, 4): true pose: maps scan points into the model's frame."""
    image: GeometryImage
    """True position and normal of each texel of the model's chart (model's frame, mm)."""
    albedo_linear: NDArray[np.float32]
    """(H, W, 3): true albedo on the model's chart; zeros outside ``image.mask``."""
    landmarks: FloatArray
    """(68, 3): true landmarks in the model's frame, mm."""
    control_points: FloatArray
    """(C, 3): control points of the true face, its fine relief left out, in the model's frame."""
    lights: tuple[PointLight, ...]
    """In the model's frame, relative to ambient = 1."""
    material: Material
    exposure: float
    """`material`, `exposure`: how the skin reflects, and the factor from radiance to the picture."""


def raw_scan(
    seed: int = 0,
    *,
    expression: Expression = "neutral",
    lights: Sequence[PointLight] | None = None,
    material: Material | None = None,
    model: AnnotatedSurface | None = None,
    scanner: Scanner = Scanner(),
) -> tuple[RawScan, SyntheticTruth]:
    """Return the scan of a random synthetic person by a virtual two-pod stereo scanner, and its truth.

    The scan is in a random pose; its texture holds both pods' pictures side by side.

    Parameters
    ----------
    seed : int
        Of the person, the noise and the pose; same seed, same scan.
    expression : str
        One of neutral, smile, frown, pout, puff, surprise.
    lights : sequence of PointLight, optional
        One flash at 0.9 m for even seeds, two for odd ones, when omitted.
    material : Material, optional
        Rough skin with a soft highlight when omitted.
    model : AnnotatedSurface, optional
        The default model when omitted; it needs landmarks.
    scanner : Scanner
    """
    sitter = sit_down(seed, expression=expression, model=model or default_model())
    if lights is None and seed % 2 == 0:
        lights = (light_at(-32, 18, distance_mm=900.0, intensity=2.5),)
    elif lights is None:
        sides = ((40, 1.8), (-40, 1.4))
        lights = tuple(light_at(side, 15, distance_mm=900.0, intensity=level) for side, level in sides)
    skin = material or Material(0.3, 0.12, 14.0)
    return scan_of(
        sitter, tuple(lights), skin, scanner, np.random.default_rng([seed, 7]), f"synthetic-{seed}"
    )


def scan_of(
    sitter: Sitter,
    flashes: tuple[PointLight, ...],
    material: Material,
    scanner: Scanner,
    rng: np.random.Generator,
    name: str,
    colors: FloatArray | None = None,
    room: Room | None = None,
) -> tuple[RawScan, SyntheticTruth]:
    """Scan a sitter as `raw_scan` does; see `flash_pictures` for `colors` and `room`."""
    tip = nose_tip(sitter.face.vertices)
    pods = two_pods(tip + HEAD_FROM_NOSE_MM, reach_mm=HEAD_REACH_MM)
    axis = tip + HEAD_AXIS_FROM_NOSE_MM
    measured = capture(
        sitter.vertices, sitter.faces, pods, spacing_mm=scanner.spacing_mm, rng=rng, axis_mm=axis
    )
    scan_from_model = random_pose(rng, scanner.rotation_max_deg)
    texture, exposure = flash_pictures(
        sitter,
        pods,
        flashes,
        material,
        size=scanner.picture_size,
        noise=_PICTURE_NOISE,
        rng=rng,
        colors=colors,
        room=room,
    )
    scan = assembled(measured, pods, texture, scan_from_model, scanner, rng, name)
    image = face_geometry_image(sitter.model, sitter.face, scanner.size)
    albedo = np.zeros((*image.shape, 3), np.float32)
    albedo[image.mask] = sitter.face_albedo(texel_coordinates(scanner.size)[image.mask.ravel()])
    truth = SyntheticTruth(
        invert_rigid(scan_from_model),
        image,
        albedo,
        sitter.face.landmarks,
        sitter.control_points,
        flashes,
        material,
        exposure,
    )
    return scan, truth


def assembled(
    measured: RangeMesh,
    pods: Sequence[Pod],
    texture: NDArray[np.float32],
    scan_from_model: FloatArray,
    scanner: Scanner,
    rng: np.random.Generator,
    name: str,
) -> RawScan:
    """Return the scan: noise, holes and crumbs on the measured mesh, textured where pictured, posed.

    The texture holds the pods' square pictures side by side.
    """
    points = disturbed(measured.vertices, measured.faces, rng, scanner.noise_mm, scanner.spikes)
    centers = points[rng.choice(len(points), scanner.holes)]
    kept = np.ones(len(measured.faces), bool)
    for center, radius in zip(centers, rng.uniform(2, 6, scanner.holes), strict=True):
        kept &= (np.linalg.norm(points[measured.faces] - center, axis=2) > radius).all(1)
    vertices, faces = join([(points, measured.faces[kept]), *crumb_meshes(points, rng, scanner.crumbs)])
    pod = np.zeros(len(faces), np.int64)
    pod[: kept.sum()] = measured.face_pod[kept]
    plane = np.stack([camera.project(vertices) for camera in pods])[pod[:, None], faces]
    pictured = (np.abs(plane) < 1).all((1, 2))
    faces, pod, plane = faces[pictured], pod[pictured], plane[pictured]
    uv = beside(plane, pod[:, None], len(pods))
    used, renumbered = np.unique(faces, return_inverse=True)
    posed = transform_points(scan_from_model, vertices[used])
    return RawScan(posed, renumbered.reshape(-1, 3), uv=uv, texture_linear=texture, name=name)


def beside(plane: FloatArray, pod: IntArray, pods: int) -> FloatArray:
    """Return texture coordinates (..., 2) of picture-plane points (..., 2) when all pictures lie in a row."""
    return np.stack([((plane[..., 0] + 1) / 2 + pod) / pods, (plane[..., 1] + 1) / 2], -1)


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
    noise_mm, spikes, rotation_max_deg, translation_max_mm
        As in `Scanner`.
    holes, crumbs : int
        Holes of 3 to 9 mm radius, loose patches in the air.
    hair, shoulders : bool
        Add a bumpy shell over the scalp, a sheet of clothes.
    scale : float
        Unit of the returned scan: 1 millimetres, 0.1 centimetres, 0.001 metres.
    """
    rng = np.random.default_rng(seed)
    shape, index = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
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
