"""Raw scans of a synthetic person with flash photographs, and their truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.point_light import PointLight
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.synthetic.face_shape import Expression, face_geometry_image
from scan2albedo.synthetic.head import HEAD_AXIS_FROM_NOSE_MM, crumb_meshes, join, nose_tip
from scan2albedo.synthetic.renderer import Material
from scan2albedo.synthetic.scanner import (
    AmbientLight,
    Pod,
    RangeMesh,
    Scanner,
    capture,
    disturbed,
    flash_pictures,
    portrait_pods,
    random_pose,
)
from scan2albedo.synthetic.scenes import light_at, texel_coordinates
from scan2albedo.synthetic.sitter import Sitter, sit_down


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
    ambient: AmbientLight | None = None,
) -> tuple[RawScan, SyntheticTruth]:
    """Scan a sitter as `raw_scan` does; see `flash_pictures` for `colors` and `ambient`."""
    tip = nose_tip(sitter.face.vertices)
    pods, axis = portrait_pods(tip), tip + HEAD_AXIS_FROM_NOSE_MM
    measured = capture(
        sitter.vertices, sitter.faces, pods, spacing_mm=scanner.spacing_mm, rng=rng, axis_mm=axis
    )
    scan_from_model = random_pose(rng, scanner.rotation_max_deg)
    size = scanner.picture_size
    texture, exposure = flash_pictures(
        sitter, pods, flashes, material, size=size, rng=rng, colors=colors, ambient=ambient
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
