"""The path-traced set of `tools/build_traced_scans.py`: its scenes, and how an albedo on them is judged.

The set lies outside the repository, in the folder that the environment variable S2A_TRACED names.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import scan2albedo as s2a
from benchmarks.albedo_peers import robust_light
from scan2albedo.albedo import albedo_error
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import srgb_to_linear
from scan2albedo.io.images import read_image_linear
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.pipeline.result import ProcessResult

VARIABLE = "S2A_TRACED"
SHARP = 0.12
"""Step of log shading between neighbouring texels of a 256 x 256 chart that makes a sharp edge."""
_STEP = 0.03
"""An albedo that steps by this much more than the texture, in log units, has an invented outline."""
_CHART = 256
_OFFSET_MM = 0.3
_DIRECTIONS = 256
_FARTHEST_MM = 2.0
_DARKEST, _UNLIT = 0.01, 0.03
DIMMEST = 0.1
"""Peers divide by no less: the light of a fit may come near 0, or below."""


def traced_folder() -> Path | None:
    """Return the folder that S2A_TRACED names, None where it is unset or holds no scene."""
    named = os.environ.get(VARIABLE)
    folder = Path(named) if named else None
    if folder is None or not (scene_names(folder, "images") or scene_names(folder, "scans")):
        return None
    return folder


def scene_names(folder: Path, kind: str) -> list[str]:
    """Return the names of the "images" or the "scans" of a folder."""
    pattern = {"images": "soft_*.npz", "scans": "p*.obj"}[kind]
    return sorted(path.stem for path in folder.glob(pattern))


@dataclass(frozen=True)
class TracedImage:
    """A geometry image with its true albedo (H, W, 3), linear, and what is known of its lamps.

    `judged` (H, W) are the texels that count: those that got light.
    """

    name: str
    image: s2a.GeometryImage
    albedo_linear: FloatArray
    judged: BoolArray
    lamps: list[dict[str, Any]]


def load_image(folder: Path, name: str) -> TracedImage:
    """Return a scene by name; files of other makers tell nothing about lamps."""
    with np.load(folder / f"{name}.npz") as stored:
        fields = dict(stored)
    with np.load(folder / f"geometry_{fields['geometry']}.npz") as stored:
        shape = dict(stored)
    image = s2a.GeometryImage(
        shape["position_mm"].astype(np.float64),
        shape["normal"].astype(np.float64),
        fields["mask"],
        texture_linear=srgb_to_linear(fields["texture_srgb8"] / 255.0).astype(np.float32),
        occluder=(shape["occluder_vertices"].astype(np.float64), shape["occluder_faces"].astype(np.int64)),
    )
    lamps = json.loads(str(fields["lights"])) if "lights" in fields else []
    albedo, mask = fields["albedo_linear"].astype(np.float64), image.mask
    judged = np.zeros(mask.shape, bool)
    assert image.texture_linear is not None
    judged[mask] = lit(image.texture_linear[mask], albedo[mask], np.ones(int(mask.sum()), bool))
    return TracedImage(name, image, albedo, judged, lamps)


def lit(texture: NDArray[np.floating], albedo: FloatArray, known: BoolArray) -> BoolArray:
    """Return which `known` (N,) texels, of colours (N, 3), got more than 3 % of the median light."""
    light = texture.max(1) / np.maximum(albedo.max(1), 1e-3)
    return known & (light > _UNLIT * np.median(light[known]))


def calibration(
    albedo: FloatArray, truth: FloatArray, expected_error: NDArray[np.floating], judged: BoolArray
) -> tuple[float, float]:
    """Return what parts of the texels err by less than what is said, and than twice that.

    `albedo` and `truth` (H, W) are V, which agree in the median; nearly black texels do not count.
    """
    at = judged & (truth > _DARKEST)
    ratio = albedo[at] / truth[at]
    off, said = np.abs(ratio / np.median(ratio) - 1), expected_error[at]
    return float(np.mean(off <= said)), float(np.mean(off <= 2 * said))


@dataclass(frozen=True)
class ScanTruth:
    """What is known about a raw scan: the surface in mm, its albedo as a linear picture, the lamps."""

    vertices_mm: FloatArray
    faces: IntArray
    uv_corners: FloatArray
    albedo_linear: FloatArray
    scan_from_truth: FloatArray
    unit_mm: float
    light_directions: FloatArray

    @classmethod
    def read(cls, folder: Path, name: str) -> ScanTruth:
        """Return the truth beside a scan."""
        with np.load(folder / f"{name}_truth.npz") as stored:
            fields = {key: stored[key] for key in stored.files}
        return cls(
            fields["vertices_mm"].astype(np.float64),
            fields["faces"].astype(np.int64),
            fields["uv_corners"].astype(np.float64),
            read_image_linear(folder / f"{name}_albedo.png").astype(np.float64),
            fields["scan_from_truth"],
            float(fields["unit_mm"]),
            fields["light_directions"],
        )

    def at(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return true albedo (N, 3) and distance (N,) in mm of points (N, 3) of the truth's frame."""
        hits = ClosestPointQuery(self.vertices_mm, self.faces).query(points)
        uv = np.einsum("nk,nkc->nc", hits.barycentric, self.uv_corners[hits.face])
        height, width = self.albedo_linear.shape[:2]
        row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
        column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
        return self.albedo_linear[row, column], hits.distance


@dataclass(frozen=True)
class JudgedScan:
    """A processed scan beside its truth: `albedo_linear` (H, W, 3) where `judged` (H, W)."""

    albedo_linear: FloatArray
    judged: BoolArray
    surface_mm: float


def judged_scan(result: ProcessResult, truth: ScanTruth) -> JudgedScan:
    """Return the true albedo on the processed chart; texels off the surface or in the dark do not count."""
    image, fitted = result.geometry_image, result.fitted
    if fitted is None:
        raise ValueError("the scan was processed without a face model, expected a fitted face")
    mask = np.asarray(image.mask)
    scan_from_model = np.linalg.inv(np.asarray(fitted.model_from_scan))
    in_scan = transform_points(scan_from_model, np.asarray(image.position, np.float64)[mask]) / truth.unit_mm
    true, distance = truth.at(transform_points(np.linalg.inv(truth.scan_from_truth), in_scan))
    assert image.texture_linear is not None
    counted = (distance < _FARTHEST_MM) & (true.min(1) > _DARKEST)
    if image.seen is not None:
        counted &= np.asarray(image.seen)[mask]
    counted = lit(np.asarray(image.texture_linear)[mask], true, counted)
    albedo, judged = np.zeros((*mask.shape, 3)), np.zeros(mask.shape, bool)
    albedo[mask], judged[mask] = true, counted
    return JudgedScan(albedo, judged, float(distance[counted].mean()))


@dataclass(frozen=True)
class AlbedoScore:
    """100 x MSE after the best single scale, on V = max(R, G, B) and on colour."""

    value_percent: float
    color_percent: float


def score(estimate: FloatArray, truth: FloatArray, judged: BoolArray) -> AlbedoScore:
    """Return the error of an albedo (H, W, 3) where `judged` (H, W).

    >>> grey = np.full((2, 2, 3), 0.4)
    >>> score(2 * grey, grey, np.ones((2, 2), bool))
    AlbedoScore(value_percent=0.0, color_percent=0.0)
    """
    value = albedo_error(estimate.max(2), truth.max(2), judged).mse_percent
    return AlbedoScore(value, albedo_error(estimate, truth, judged).mse_percent)


@dataclass(frozen=True)
class InventedOutlines:
    """Of `edges` sharp steps of the shading, the share where the albedo steps more than the texture.

    `mean_excess` is by how much on average, in log units, less steps counted as none.
    """

    edges: int
    share: float
    mean_excess: float


def invented_outlines(
    texture: FloatArray, shading: FloatArray, albedo: FloatArray, mask: BoolArray
) -> InventedOutlines:
    """Return how often dividing by the shading (H, W) made an edge of V (H, W) larger; judged at 256 x 256.

    True shading scores 0.05 to 0.27 and 0.006 to 0.037: grain and noise step too.
    """
    fields = [_area(field) for field in (texture, shading, albedo)]
    known = _area(mask) > 0.99
    for field in fields:
        known &= field > 1e-3
    both = np.stack([known & np.roll(known, -1, axis=axis) for axis in (0, 1)])
    both[0, -1], both[1, :, -1] = False, False
    of_texture, of_shading, of_albedo = (np.abs(_steps(np.log(np.maximum(f, 1e-4)))) for f in fields)
    edge = both & (of_shading > SHARP)
    if not edge.any():
        return InventedOutlines(0, 0.0, 0.0)
    excess = of_albedo[edge] - of_texture[edge]
    return InventedOutlines(
        int(edge.sum()), float((excess > _STEP).mean()), float(np.maximum(excess, 0).mean())
    )


def _area(field: FloatArray | BoolArray) -> FloatArray:
    full = np.nan_to_num(np.asarray(field, np.float32))
    return cv2.resize(full, (_CHART, _CHART), interpolation=cv2.INTER_AREA).astype(np.float64)


def _steps(field: FloatArray) -> FloatArray:
    """Return (2, H, W) steps to the lower and to the right neighbour, round the edge at the last ones."""
    return np.stack([np.roll(field, -1, axis=axis) - field for axis in (0, 1)])


@dataclass(frozen=True)
class Received:
    """What texels receive of light from everywhere: with the face's own shadows, without; and occlusion.

    `shadowed` and `plain` (N, 9) respond to harmonics up to degree 2, `open_part` (N,) is 1 in the open.
    """

    shadowed: FloatArray
    plain: FloatArray
    open_part: FloatArray


def received(image: s2a.GeometryImage) -> Received:
    """Return the cosine transfer of a geometry image's texels by rays in 256 directions."""
    position, normal = image.position[image.mask], image.normal[image.mask]
    caster, directions = RayCaster(*image.occluder_mesh()), distant_directions(_DIRECTIONS)
    start, basis = position + _OFFSET_MM * normal, harmonics(directions, 2)
    shadowed, plain, open_part = np.zeros((len(start), 9)), np.zeros((len(start), 9)), np.zeros(len(start))
    for direction, row in zip(directions, basis, strict=True):
        cosine = np.maximum(normal @ direction, 0)
        facing = cosine > 0
        free = cosine.copy()
        toward = np.broadcast_to(direction, (int(facing.sum()), 3))
        free[facing] *= ~caster.occluded(start[facing], toward)
        shadowed += free[:, None] * row
        plain += cosine[:, None] * row
        open_part += free
    share = 4 / len(directions)
    return Received(share * shadowed, share * plain, share * open_part)


def simple_peers(image: s2a.GeometryImage) -> dict[str, FloatArray]:
    """Return albedos (H, W, 3) by name: texture as is, on occlusion, on harmonics without and with shadows.

    Each channel is divided by its own light, of median 1: coloured light that differs from place to place is
    theirs to take off. Light below a tenth of its median is taken for a tenth.
    """
    assert image.texture_linear is not None
    mask, light = image.mask, received(image)
    texture = np.asarray(image.texture_linear, np.float64)[mask]

    def divided(by: FloatArray) -> FloatArray:
        albedo = np.zeros((*mask.shape, 3))
        albedo[mask] = texture / by
        return albedo

    def fitted(basis: FloatArray) -> FloatArray:
        lights = np.stack([robust_light(basis, channel) for channel in texture.T], 1)
        return divided(np.maximum(lights / np.median(lights, axis=0), DIMMEST))

    return {
        "as is": divided(np.ones((len(texture), 1))),
        "AO": divided(np.maximum(light.open_part, DIMMEST)[:, None]),
        "SH": fitted(light.plain),
        "SH+shadows": fitted(light.shadowed),
    }


def all_images(folder: Path) -> Iterator[TracedImage]:
    """Yield the geometry images of a folder."""
    for name in scene_names(folder, "images"):
        yield load_image(folder, name)
