"""Scenes whose albedo is known, and how an albedo on them is judged.

They lie outside the repository, in the folder that the environment variable S2A_TRACED names: the
path-traced set of `python tools/worlds`, raw scans with photographed skin, or photographs of people
under flashes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import scan2albedo as s2a
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
_OFFSET_MM = 0.3
"""Shadow rays start this far from the surface."""
_DIRECTIONS = 256
"""In which shadow rays are cast."""
_FARTHEST_MM = 2.0
"""Texels farther from the true surface do not count."""
_DARKEST = 0.01
"""Darker true albedos do not count."""
_UNLIT = 0.03
"""Texels with less of the median light do not count."""
PATTERNS = {"skin": "d_*.obj", "flashes": "yale*.npz", "scans": "p*.obj", "images": "soft_*.npz"}
"""Files of each kind of scene, people's skin before painted heads."""
_AMBIENT = 0.06
"""Light of a flash photograph besides the flash."""
_REACHED = 0.1
"""Least light of the flash for a texel to count."""
_EXPLAINED = 0.25
"""How far from what the true light explains a texel of a flash photograph may be."""
DIMMEST = 0.1
"""Peers divide by no less: the light of a fit may come near 0, or below."""


def traced_folder() -> Path | None:
    """Return the folder that S2A_TRACED names, None where it is unset or holds no scene."""
    named = os.environ.get(VARIABLE)
    folder = Path(named) if named else None
    if folder is None or not any(scene_names(folder, kind) for kind in PATTERNS):
        return None
    return folder


def scene_names(folder: Path, kind: str) -> list[str]:
    """Return the names of a folder's scenes of a kind, one of `PATTERNS`."""
    return sorted(path.stem for path in folder.glob(PATTERNS[kind]))


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
        shape["position_mm"].astype(float),
        shape["normal"].astype(float),
        fields["mask"],
        texture_linear=srgb_to_linear(fields["texture_srgb8"] / 255.0).astype(np.float32),
        occluder=(shape["occluder_vertices"].astype(float), shape["occluder_faces"].astype(np.int64)),
    )
    lamps = json.loads(str(fields["lights"])) if "lights" in fields else []
    albedo, mask = fields["albedo_linear"].astype(float), image.mask
    judged = np.zeros(mask.shape, bool)
    judged[mask] = lit(image.texture_linear[mask], albedo[mask], np.ones(int(mask.sum()), bool))
    return TracedImage(name, image, albedo, judged, lamps)


def flash_photograph(person: Mapping[str, NDArray], k: int) -> tuple[s2a.GeometryImage, BoolArray]:
    """Return a photograph of Extended Yale B, and the texels (H, W) that its flash explains to a quarter.

    The relief is only roughly right, so cast shadows do not lie where it says: others do not count.
    """
    position, normal, albedo = (person[key].astype(float) for key in ("position_mm", "normal", "albedo"))
    mask = person["mask"]
    value = np.where(mask, person["texture_linear8"][k] / 255.0, 0.0)
    flash = person["strength"][k] * np.maximum(normal @ person["direction"][k].astype(float), 0)
    expected = np.maximum((flash + _AMBIENT) * albedo, 1e-3)
    explained = mask & (flash > _REACHED) & (np.abs(value / expected - 1) < _EXPLAINED)
    texture = np.repeat(value[..., None], 3, 2).astype(np.float32)
    return s2a.GeometryImage(position, normal, mask, texture_linear=texture), explained


def load_flashes(folder: Path, name: str) -> Iterator[TracedImage]:
    """Yield a person of Extended Yale B under each flash, with the albedo by photometric stereo."""
    with np.load(folder / f"{name}.npz") as stored:
        fields = dict(stored)
    albedo = np.repeat(fields["albedo"].astype(float)[..., None], 3, 2)
    for k, light in enumerate(fields["lights"]):
        image, judged = flash_photograph(fields, k)
        yield TracedImage(f"{name}_{light}", image, albedo, judged, [{"hard": True}])


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
    """What is known about a raw scan: the surface in mm, its albedo as a linear picture, the lamps.

    `valid` (H, W), of a size of its own, are the texels of the picture that show skin or hair; all when None.
    """

    vertices_mm: FloatArray
    faces: IntArray
    uv_corners: FloatArray
    albedo_linear: FloatArray
    scan_from_truth: FloatArray
    unit_mm: float
    lamps: int
    valid: BoolArray | None = None

    @classmethod
    def read(cls, folder: Path, name: str) -> ScanTruth:
        """Return the truth beside a scan; the two sets call some of it by other names."""
        beside = folder / f"{name}_truth.npz"
        with np.load(beside if beside.is_file() else folder / "truth" / f"{name}.npz") as stored:
            fields = dict(stored)
        return cls(
            fields["vertices_mm" if "vertices_mm" in fields else "vertices"].astype(float),
            fields["faces"].astype(np.int64),
            fields["uv_corners"].astype(float),
            read_image_linear(folder / f"{name}_albedo.png").astype(float),
            fields["scan_from_truth" if "scan_from_truth" in fields else "scan_from_canonical"],
            float(fields["unit_mm"]),
            len(fields["light_directions"]) if "light_directions" in fields else int(fields["lights"]),
            fields.get("valid"),
        )

    def at(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return true albedo (N, 3), NaN where it is not valid, and distance (N,) in mm of points (N, 3).

        The points are of the truth's frame.
        """
        hits = ClosestPointQuery(self.vertices_mm, self.faces).query(points)
        uv = np.einsum("nk,nkc->nc", hits.barycentric, self.uv_corners[hits.face])

        def looked_up(picture: NDArray) -> NDArray:
            height, width = picture.shape[:2]
            row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
            return picture[row, np.clip((uv[:, 0] * width).astype(int), 0, width - 1)]

        albedo = looked_up(self.albedo_linear)
        if self.valid is not None:
            albedo[~looked_up(self.valid)] = np.nan
        return albedo, hits.distance


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
    in_scan = transform_points(scan_from_model, np.asarray(image.position, float)[mask]) / truth.unit_mm
    true, distance = truth.at(transform_points(np.linalg.inv(truth.scan_from_truth), in_scan))
    # Comparisons with NaN are false.
    counted = (distance < _FARTHEST_MM) & (true.max(1) > _DARKEST)
    if image.seen is not None:
        counted &= np.asarray(image.seen)[mask]
    counted = lit(np.asarray(image.texture_linear)[mask], true, counted)
    albedo, judged = np.zeros((*mask.shape, 3)), np.zeros(mask.shape, bool)
    albedo[mask], judged[mask] = true, counted
    return JudgedScan(albedo, judged, float(distance[counted].mean()))


@dataclass(frozen=True)
class AlbedoScore:
    """Errors in percent after the best single scale, on V = max(R, G, B) unless they are of colour.

    `rmse` and `color_rmse` are relative, ||a A - A_true|| / ||A_true||; half of the texels err by less than
    `half` of their own albedo, 95 in 100 by less than `most`; `mse` and `color_mse` are 100 x MSE.
    """

    rmse: float
    half: float
    most: float
    color_rmse: float
    mse: float
    color_mse: float


def score(estimate: FloatArray, truth: FloatArray, judged: BoolArray) -> AlbedoScore:
    """Return the errors of an albedo (H, W, 3) where `judged` (H, W).

    >>> grey = np.full((2, 2, 3), 0.4)
    >>> score(2 * grey, grey, np.ones((2, 2), bool)).rmse
    0.0
    """
    ours, true = estimate.max(2), truth.max(2)
    value, color = albedo_error(ours, true, judged), albedo_error(estimate, truth, judged)
    ours, true = ours[judged], true[judged]
    scale = (ours @ true) / max(ours @ ours, 1e-12)
    of_texel = 100 * np.abs(scale * ours / np.maximum(true, _DARKEST) - 1)
    half, most = np.percentile(of_texel, (50, 95))
    return AlbedoScore(
        100 * value.relative_rmse,
        float(half),
        float(most),
        100 * color.relative_rmse,
        value.mse_percent,
        color.mse_percent,
    )


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


def robust_light(basis: FloatArray, lit: FloatArray) -> FloatArray:
    """Return (N,) the light `basis` (N, K) c that is nearest to `lit` (N,) in L1: albedo is constant."""
    weight = np.ones(len(lit))
    coefficients: FloatArray = np.zeros(basis.shape[1])
    for _ in range(30):
        scaled = basis * weight[:, None]
        coefficients = np.asarray(np.linalg.lstsq(scaled.T @ basis, scaled.T @ lit, rcond=None)[0], float)
        weight = 1 / np.maximum(np.abs(basis @ coefficients - lit), 1e-3)
    return np.maximum(basis @ coefficients, 0.02 * np.median(basis @ coefficients))


def simple_peers(image: s2a.GeometryImage, light: Received | None = None) -> dict[str, FloatArray]:
    """Return albedos (H, W, 3) by name: texture as is, on occlusion, on harmonics without and with shadows.

    Each channel is divided by its own light, of median 1: coloured light that differs from place to place is
    theirs to take off. Light below a tenth of its median is taken for a tenth. `light` is what the texels
    receive, where that is known.
    """
    mask, light = image.mask, light or received(image)
    texture = np.asarray(image.texture_linear, float)[mask]

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


def relative_rmse(found: FloatArray, truth: FloatArray) -> float:
    """Return the root mean square error over that of the truth."""
    return float(np.sqrt(np.mean((found - truth) ** 2) / np.mean(truth**2)))


def rms(errors: FloatArray) -> float:
    """Return the root mean square of lengths (N,), NaN of none."""
    return float(np.sqrt((errors**2).mean())) if len(errors) else float("nan")


def picture_errors(made: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Return the rms of errors over the mean brightness, and the one that a hundredth exceeds."""
    off = np.abs(made - truth).mean(2) / truth.mean()
    return float(np.sqrt((off**2).mean())), float(np.percentile(off, 99))
