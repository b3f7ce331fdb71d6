"""Geometry images: how much of the scan's texture and of the surface an image of each size keeps.

Synthetic raw scans, fitted from their true pose. At 40,000 points drawn over the surface: relative RMSE of
linear colour, in percent, and mm by which the surface interpolated between texels is off. The peer looks
colours up at the fitted vertices and interpolates them over the mesh: what needs no chart.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

import scan2albedo as s2a
from bench.judging import relative_rmse
from bench.runner import Bench, Case
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_areas, face_normals, vertex_normals
from scan2albedo.geometry.rasterization import pixels_from_uv
from scan2albedo.geometry.rigid import invert_rigid, transform_directions, transform_points
from scan2albedo.sampling.texture_lookup import sample_colors
from scan2albedo.synthetic import Scanner, raw_scan

SIZES = (32, 64, 96, 128, 192, 256, 384, 512, 768, 1024)
POINTS = 40_000
POINT_MM = 1e-3
"""Footprint of a point's own colour in the picture: next to none."""


@dataclass(frozen=True)
class SampledFace:
    """A fitted face, its scan, and what the surface is like at `uv` (N, 2) drawn at random."""

    scan: s2a.RawScan
    fitted: s2a.FittedFace
    uv: FloatArray
    position: FloatArray
    color_linear: FloatArray


def colors_at(scan: s2a.RawScan, fitted: s2a.FittedFace, position: FloatArray, normal: FloatArray):  # type: ignore[no-untyped-def]
    """Return what the scan's pictures show at points of the fitted surface."""
    scan_from_model = invert_rigid(fitted.model_from_scan)
    step = np.broadcast_to(POINT_MM * np.eye(3)[:, :2], (len(position), 3, 2))
    return sample_colors(
        scan,
        transform_points(scan_from_model, position),
        transform_directions(scan_from_model, normal),
        step,
    )


def sampled_face(seed: int, picture_size: int) -> SampledFace:
    model = s2a.AnnotatedFaceModel.default()
    scan, truth = raw_scan(seed, model=model, scanner=Scanner(picture_size=picture_size, size=32))
    fitted = s2a.fit(scan, model, truth.model_from_scan)
    rng = np.random.default_rng(seed)
    area = face_areas(fitted.vertices, fitted.faces)
    face = rng.choice(len(area), POINTS, p=area / area.sum())
    barycentric = rng.dirichlet(np.ones(3), POINTS)
    position, uv = (
        np.einsum("nk,nkc->nc", barycentric, values[fitted.faces[face]])
        for values in (fitted.vertices, fitted.uv)
    )
    found = colors_at(scan, fitted, position, face_normals(fitted.vertices, fitted.faces)[face])
    seen = found.seen
    return SampledFace(scan, fitted, uv[seen], position[seen], found.color_linear[seen].astype(float))


def cases(quick: bool) -> Iterator[Case]:
    for seed in range(1 if quick else 2):
        yield Case(f"person {seed}", partial(sampled_face, seed, 96 if quick else 900))


def vertex_colors(scene: SampledFace) -> FloatArray:
    """Return the colours (N, 3) of the points, interpolated between the fitted mesh's vertices."""
    fitted = scene.fitted
    normals = vertex_normals(fitted.vertices, fitted.faces)
    colors = colors_at(scene.scan, fitted, fitted.vertices, normals).color_linear
    hits = ClosestPointQuery(fitted.vertices, fitted.faces).query(scene.position)
    return hits.interpolated(colors, fitted.faces)


def interpolated(
    image: s2a.GeometryImage, values: NDArray[np.floating], uv: FloatArray, usable: BoolArray
) -> tuple[BoolArray, FloatArray]:
    """Return which points (N,) have four usable texels around them, and the values bilinear there."""
    column, row = pixels_from_uv(uv, image.shape).T
    left = np.clip(np.floor(column).astype(int), 0, image.shape[1] - 2)
    above = np.clip(np.floor(row).astype(int), 0, image.shape[0] - 2)
    x, y = column - left, row - above
    known = np.ones(len(uv), bool)
    total = np.zeros((len(uv), 3))
    for down in (0, 1):
        for right in (0, 1):
            weight = (x if right else 1 - x) * (y if down else 1 - y)
            known &= usable[above + down, left + right]
            total += weight[:, None] * values[above + down, left + right]
    return known, total[known]


def errors(scene: SampledFace, found: s2a.GeometryImage | FloatArray) -> dict[str, float]:
    if isinstance(found, np.ndarray):
        return {"texture %": 100 * relative_rmse(found, scene.color_linear)}
    inside, position = interpolated(found, found.position, scene.uv, found.mask)
    seen, color = interpolated(found, found.texture_linear, scene.uv, found.seen)
    return {
        "texture %": 100 * relative_rmse(color, scene.color_linear[seen]),
        "surface mm": float(np.linalg.norm(position - scene.position[inside], axis=1).mean()),
    }


BENCH = Bench(
    cases,
    methods={
        f"size {size}": lambda scene, size=size: s2a.geometry_image(scene.fitted, scene.scan, size)
        for size in SIZES
    },
    peers={"colours at vertices": vertex_colors},
    score=errors,
    quick=("size 32", "size 64", "colours at vertices"),
    warm=True,
)
