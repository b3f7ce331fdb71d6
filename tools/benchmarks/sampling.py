"""Geometry images: how much of the scan's texture and of the surface an image of each size keeps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.presets import SizeOptions, preset_settings
from benchmarks.sweep import ErrorKind, Outcome, Peer, Setting, StageBenchmark, timed
from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import GeometryImage, RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.geometry.mesh import face_areas, face_normals
from scan2albedo.geometry.rasterization import pixels_from_uv
from scan2albedo.geometry.rigid import invert_rigid, transform_directions, transform_points
from scan2albedo.sampling import geometry_image
from scan2albedo.sampling.texture_lookup import sample_colors
from scan2albedo.synthetic import Scanner, raw_scan

SIZES = (64, 96, 128, 192, 256, 384, 512, 768, 1024)
_POINTS = 40_000
_POINT_MM = 1e-3
"""Footprint of a point's own colour in the picture: next to none."""
_SCENES, _QUICK_SCENES = 2, 1


@dataclass(frozen=True)
class SampledFace:
    """A fitted face, its scan, and what the surface is like at `uv` (N, 2) drawn at random."""

    scan: RawScan
    fitted: FittedFace
    uv: FloatArray
    position: FloatArray
    color_linear: NDArray[np.float32]


@cache
def _sampled_face(seed: int, picture_size: int) -> SampledFace:
    model = AnnotatedFaceModel.default()
    scanner = Scanner(picture_size=picture_size, size=32)
    scan, truth = raw_scan(seed, model=model, scanner=scanner)
    fitted = fit(scan, model, truth.model_from_scan)
    rng = np.random.default_rng(seed)
    area = face_areas(fitted.vertices, fitted.faces)
    face = rng.choice(len(area), _POINTS, p=area / area.sum())
    barycentric = rng.dirichlet(np.ones(3), _POINTS)
    position, uv = (
        np.einsum("nk,nkc->nc", barycentric, values[fitted.faces[face]])
        for values in (fitted.vertices, fitted.uv)
    )
    scan_from_model = invert_rigid(fitted.model_from_scan)
    normal = face_normals(fitted.vertices, fitted.faces)[face]
    step = np.broadcast_to(_POINT_MM * np.eye(3)[:, :2], (_POINTS, 3, 2))
    found = sample_colors(
        scan, transform_points(scan_from_model, position), transform_directions(scan_from_model, normal), step
    )
    seen = found.seen
    return SampledFace(scan, fitted, uv[seen], position[seen], found.color_linear[seen])


def _settings(quick: bool) -> list[Setting]:
    default = Setting("default", "", SizeOptions())
    if quick:
        return [Setting("size", str(n), SizeOptions(n)) for n in (32, 64)]
    sizes = [Setting("size", str(n), SizeOptions(n)) for n in SIZES if n != SizeOptions().size]
    return [default, *preset_settings("geometry_image"), *sizes]


def _run(scene: SampledFace, setting: Setting) -> Outcome:
    made: SizeOptions = setting.options

    def work() -> GeometryImage:
        return geometry_image(scene.fitted, scene.scan, made.size)

    image, cost = timed(work)
    inside, position = _interpolated(image, image.position, scene.uv, image.mask)
    seen, color = _interpolated(image, image.texture_linear, scene.uv, image.seen)
    apart = np.linalg.norm(position - scene.position[inside], axis=1)
    off = color - scene.color_linear[seen]
    relative = np.sqrt((off**2).sum() / (scene.color_linear[seen].astype(float) ** 2).sum())
    details = {"texels used": float(image.mask.sum())}
    return Outcome(cost, (100 * float(relative), float(apart.mean())), 0, details)


def _interpolated(
    image: GeometryImage, values: Any, uv: FloatArray, usable: BoolArray
) -> tuple[BoolArray, FloatArray]:
    """Return which points (N,) have four usable texels around them, and the values bilinear there."""
    column, row = pixels_from_uv(uv, image.shape).T
    left = np.clip(np.floor(column).astype(int), 0, image.shape[1] - 2)
    above = np.clip(np.floor(row).astype(int), 0, image.shape[0] - 2)
    x, y = column - left, row - above
    known, total = np.ones(len(uv), bool), np.zeros((len(uv), 3))
    for down in (0, 1):
        for right in (0, 1):
            weight = (x if right else 1 - x) * (y if down else 1 - y)
            known &= usable[above + down, left + right]
            total += weight[:, None] * values[above + down, left + right]
    return known, total[known]


def _scenes(quick: bool) -> list[SampledFace]:
    return [_sampled_face(seed, 96 if quick else 900) for seed in range(_QUICK_SCENES if quick else _SCENES)]


def _peers(quick: bool) -> list[Peer]:
    return [Peer("colours at the fit's vertices", _vertex_colors)]


def _vertex_colors(scene: SampledFace) -> Outcome:
    """Colour looked up at the vertices of the fitted mesh and interpolated: what needs no chart."""
    fitted = scene.fitted
    scan_from_model = invert_rigid(fitted.model_from_scan)

    def work() -> NDArray[np.float32]:
        from scan2albedo.geometry.mesh import vertex_normals

        normals = vertex_normals(fitted.vertices, fitted.faces)
        step = np.broadcast_to(_POINT_MM * np.eye(3)[:, :2], (len(fitted.vertices), 3, 2))
        return sample_colors(
            scene.scan,
            transform_points(scan_from_model, fitted.vertices),
            transform_directions(scan_from_model, normals),
            step,
        ).color_linear

    color, cost = timed(work)
    from scan2albedo.geometry.closest_points import ClosestPointQuery

    hits = ClosestPointQuery(fitted.vertices, fitted.faces).query(scene.position)
    found = np.einsum("nk,nkc->nc", hits.barycentric, color[fitted.faces[hits.face]])
    off = found - scene.color_linear
    relative = np.sqrt((off**2).sum() / (scene.color_linear.astype(float) ** 2).sum())
    return Outcome(cost, (100 * float(relative), float("nan")))


BENCHMARK = StageBenchmark(
    "geometry_image",
    (ErrorKind("texture, relative RMSE", "%"), ErrorKind("surface", "mm")),
    _scenes,
    _settings,
    _run,
    _peers,
)
