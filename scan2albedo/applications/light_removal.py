"""`unlit_scan`: the scan as it came, its vertices, coordinates and texels, without its light.

What divides a texel of the scan is the light of the chart there, T / A with all repairs of the albedo: it
changes slowly, and so the chart's resolution serves. Detail and noise are the scan's own, and the noise is
filtered on the scan's own texels as it was on the chart.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.albedo.division import Usual, divide_light
from scan2albedo.albedo.result import shade_image
from scan2albedo.applications.scan_on_chart import ScanOnChart, scan_on_chart
from scan2albedo.applications.shadow_lines import outlines, without_lines
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import ApplicationError
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import face_areas, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv, rasterize
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.geometry.thinning import thinned
from scan2albedo.io.texture_atlas import in_first_period

REACHES = ("face", "all")
"""How far the light is taken off: where the model was fitted, or from the whole scan."""
OUTSIDE_CONFIDENCE = 0.5
"""Relative to the face: beyond the model the light is that of its lamps on the scan's own, rougher shape."""
DARKEST = 0.1
"""Least light that divides, as a part of the usual: less makes noise bright, more leaves deep shadows dark
(`tools/bench_unlit.py traced`)."""
_ROUGHER = 2.0
"""How much farther noise is averaged than on a chart of such texels, each a mean over its footprint."""
_BLACK = 1e-3
"""Albedo below which the light is that of the estimate, not the quotient of two colours."""
_SPOT, _DARK_SPOT = 0.012, 0.7
"""Half side of what is around a spot, as a part of the chart's, and how much darker it is, as a logarithm:
by eye, on the folded lips of a coarse template."""
_SHADED_MM = 2.5
"""Beyond the face light is found on the scan with so much between its vertices."""
_TILE, _MARGIN, _GUTTER = 2048, 128, 16
"""Texels of a tile's side, of what is looked at beside it, and of the light's going on beside charts."""


@dataclass(frozen=True)
class UnlitScan:
    """A scan without its light, as bright as it was on average."""

    scan: RawScan
    """With its own vertices, faces and coordinates; its texture, or vertex colours, are unlit."""
    confidence: NDArray[np.float32]
    """(H, W) of the texture, or (V,): how surely the light was taken off: 1 on the face, 0 where it was left
    in, `OUTSIDE_CONFIDENCE` beyond the face."""


def unlit_scan(scan: RawScan, fitted: FittedFace, estimate: AlbedoEstimate, reach: str = "face") -> UnlitScan:
    """Return the scan without the light that was found on its face.

    Parameters
    ----------
    scan : RawScan
        With colour; what `fitted` was fitted to.
    fitted : FittedFace
    estimate : AlbedoEstimate
        Of the geometry image of both.
    reach : {"face", "all"}
        Beyond the face the light stays in and the colours meet at its rim; or "all" goes on with the same
        lamps and environment on the scan's own shape, which shadows itself.

    Raises
    ------
    ApplicationError
        When the scan has no colour or is not where the face was fitted, or the albedo is of another face.
    ValueError
        For another `reach`.

    Notes
    -----
    Linear in the texels. Tiles of the texture take turns: beside it and its copy, memory does not grow.
    """
    require_type(scan, RawScan, "unlit_scan: scan", "load_scan(path) returns one")
    require_type(fitted, FittedFace, "unlit_scan: fitted", "fit(scan, model, pose) returns one")
    require_type(estimate, AlbedoEstimate, "unlit_scan: estimate", "estimate_albedo(image) returns one")
    if reach not in REACHES:
        raise ValueError(f"reach is {reach!r}, expected one of {', '.join(REACHES)}")
    if not scan.has_color:
        raise ApplicationError(f"{scan.name}: the scan has no colours, and so no light to take off")
    occluder = estimate.image.occluder
    if occluder is None or not np.array_equal(occluder[0], fitted.vertices):
        raise ApplicationError(f"{scan.name}: the albedo was estimated of another face than the fitted one")
    light = _ChartLight.of(estimate)
    on_chart = scan_on_chart(scan, fitted, estimate.image)
    if not on_chart.weight.any():
        raise ApplicationError(
            f"{scan.name}: no part of the scan lies at the fitted face; give the scan it was fitted to"
        )
    if reach == "all":
        beyond = _light_beyond(scan, fitted, estimate, DARKEST * light.usual)
        parts = _Parts(scan, light, on_chart, *beyond, OUTSIDE_CONFIDENCE)
    else:
        usual = np.full((len(scan.vertices), 3), math.log(light.usual))
        parts = _Parts(scan, light, on_chart, usual, np.zeros((len(scan.vertices), 2)), 0.0)
    notes = (*scan.notes, f"the light was taken off {'the face' if reach == 'face' else 'everything'}")
    if scan.uv is not None and scan.texture_linear is not None:
        texture, confidence = _unlit_texture(parts, scan.texture_linear, scan.uv)
        return UnlitScan(replace(scan, texture_linear=texture, notes=notes), confidence)
    assert scan.vertex_color_linear is not None
    divisor, sure = parts.light_at(on_chart.uv, on_chart.weight, parts.log_beyond)
    colors = (scan.vertex_color_linear * (light.usual / divisor)).astype(np.float32)
    return UnlitScan(replace(scan, vertex_color_linear=colors, notes=notes), sure.astype(np.float32))


@dataclass(frozen=True)
class _ChartLight:
    """The light on the chart: `log_light` (H, W, 3), and the `usual` light.

    A chart of the same face with texels of 1 mm has a side of `side_mm`.
    """

    log_light: FloatArray
    usual: float
    side_mm: float

    @classmethod
    def of(cls, estimate: AlbedoEstimate) -> _ChartLight:
        """Take the light that divided the texture, with all repairs."""
        image, mask = estimate.image, estimate.image.mask
        assert image.texture_linear is not None
        albedo = estimate.albedo_linear.astype(np.float64)
        usual = float(np.median(estimate.shading.mean(-1)[image.seen if image.seen.any() else mask]))
        black = _BLACK * max(float(np.median(albedo[mask])), 1e-12)
        light = (image.texture_linear + black * estimate.shading) / (albedo + black)
        log_light = np.log(np.maximum(light, DARKEST * usual))
        areas = image.texel_areas_mm2()
        return cls(
            log_light=_without_dark_spots(filled_from_nearest(log_light, mask)),
            usual=usual,
            side_mm=max(mask.shape) * float(np.sqrt(np.median(areas))) if len(areas) else max(mask.shape),
        )


def _without_dark_spots(log_light: FloatArray) -> FloatArray:
    """Return log light (H, W, 3) without small spots much darker than around: folds of the surface."""
    import cv2

    mean = log_light.mean(-1)
    side = 2 * round(_SPOT * max(mean.shape)) + 1
    low, high = float(mean.min()), float(mean.max())
    steps = np.round((mean - low) * (255 / max(high - low, 1e-9))).astype(np.uint8)
    usual = low + cv2.medianBlur(steps, side).astype(np.float64) * ((high - low) / 255)
    return log_light + np.maximum(usual - _DARK_SPOT - mean, 0.0)[..., None]


@dataclass(frozen=True)
class _Parts:
    """What every texel of a scan is divided by: light on the chart, and beyond it (V, 3).

    `outlines` (V, 2) are those of the latter, see `shadow_lines`.
    """

    scan: RawScan
    light: _ChartLight
    on_chart: ScanOnChart
    log_beyond: FloatArray
    outlines: FloatArray
    outside: float

    @property
    def side(self) -> int:
        """Side of a chart of the face with texels as large as the scan's are there."""
        if self.texels_per_mm <= 0:
            return max(self.light.log_light.shape)
        return max(1, round(_ROUGHER * self.light.side_mm * self.texels_per_mm))

    @cached_property
    def texels_per_mm(self) -> float:
        """Of the scan's texture on the face; 0 where none is."""
        scan, texture = self.scan, self.scan.texture_linear
        face = (self.on_chart.weight[scan.faces] > 0).all(1)
        if texture is None or scan.uv is None or not face.any():
            return 0.0
        first, second, third = np.moveaxis(
            pixels_from_uv(scan.uv[face].reshape(-1, 2), texture.shape[:2]).reshape(-1, 3, 2), 1, 0
        )
        across, beside = second - first, third - first
        texels = np.abs(across[:, 0] * beside[:, 1] - across[:, 1] * beside[:, 0]) / 2
        area_mm2 = face_areas(scan.vertices, scan.faces[face]).sum()
        return float(np.sqrt(texels.sum() / max(area_mm2, 1e-12)))

    def light_at(
        self, uv: FloatArray, weight: FloatArray, log_beyond: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the light (N, 3) and how surely it is known (N,) at places (N, 2) of the chart.

        These count by `weight` (N,), the light beyond them (N, 3) by the rest.
        """
        pixels = pixels_from_uv(uv, self.light.log_light.shape[:2])
        share = weight[:, None]
        log_light = share * bilinear(self.light.log_light, pixels) + (1 - share) * log_beyond
        return np.exp(log_light), weight + (1 - weight) * self.outside


def _light_beyond(
    scan: RawScan, fitted: FittedFace, estimate: AlbedoEstimate, least: float
) -> tuple[FloatArray, FloatArray]:
    """Return log light (V, 3) of the estimate's lamps and environment on the scan's own shape.

    And (V, 2) where it has `outlines`.
    """
    vertices = transform_points(fitted.model_from_scan, scan.vertices)
    thin = thinned(vertices, scan.faces, _SHADED_MM)
    if len(thin.faces) == 0:
        thin = thinned(vertices, scan.faces, 0.0)
    surface = GeometryImage(
        position=thin.vertices[None],
        normal=vertex_normals(thin.vertices, thin.faces)[None],
        mask=np.ones((1, len(thin.vertices)), bool),
    )
    lit = shade_image(
        surface,
        estimate.lights,
        estimate.reflectance,
        estimate.view_direction,
        RayCaster(thin.vertices, thin.faces) if estimate.casts_shadows else None,
        estimate.shadow_offset_mm,
        estimate.environment,
    ).shading.light_linear
    log_lit = np.log(np.maximum(lit, least))
    hits = surface_query(thin.vertices, thin.faces).query(vertices)
    log_beyond = np.einsum("nk,nkc->nc", hits.barycentric, log_lit[thin.faces[hits.face]])
    return log_beyond, outlines(thin.vertices, thin.faces, log_lit, vertices)


def _unlit_texture(
    parts: _Parts, texture: NDArray[np.float32], uv: FloatArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the texture (H, W, 3) without its light, and the confidence (H, W); where no face is, as is."""
    shape = texture.shape[:2]
    corners = pixels_from_uv(in_first_period(uv, texture.shape).reshape(-1, 2), shape).reshape(-1, 3, 2)
    first, last = np.floor(corners.min(1)), np.ceil(corners.max(1))
    result, confidence = np.array(texture), np.zeros(shape, np.float32)
    usual = None
    for top, left in _tiles(shape, corners.mean(1)[(parts.on_chart.weight[parts.scan.faces] > 0).any(1)]):
        low = np.array([max(left - _MARGIN, 0), max(top - _MARGIN, 0)])
        high = np.minimum([left + _TILE + _MARGIN, top + _TILE + _MARGIN], [shape[1], shape[0]])
        inside = np.flatnonzero(((last >= low) & (first <= high)).all(1))
        if len(inside) == 0:
            continue
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        unlit, sure, usual = _unlit_tile(parts, texture[window], corners[inside] - low, inside, usual)
        own = np.s_[top - low[1] : top - low[1] + _TILE, left - low[0] : left - low[0] + _TILE]
        result[top : top + _TILE, left : left + _TILE] = unlit[own]
        confidence[top : top + _TILE, left : left + _TILE] = sure[own]
    return result, confidence


def _tiles(shape: tuple[int, int], face: FloatArray) -> list[tuple[int, int]]:
    """Return (top, left) of the tiles of a texture, that first which has most of the places `face` (N, 2).

    What is usual there serves for all, so that they join without a seam.
    """
    places = (np.clip(face[:, ::-1], 0, np.array(shape) - 1) // _TILE).astype(np.int64) * _TILE
    count = Counter(map(tuple, places.tolist()))
    every = [(top, left) for top in range(0, shape[0], _TILE) for left in range(0, shape[1], _TILE)]
    return sorted(every, key=lambda tile: -count[tile])


def _unlit_tile(
    parts: _Parts,
    texture: NDArray[np.float32],
    corners: FloatArray,
    faces: NDArray[np.int64],
    usual: Usual | None,
) -> tuple[FloatArray, FloatArray, Usual | None]:
    """Return a tile of the texture without its light, how surely it was taken off, and what is usual.

    `corners` (N, 3, 2) are the places, in pixels of the tile, of the scan's `faces` (N,).
    """
    index = np.arange(3 * len(corners)).reshape(-1, 3)
    raster = rasterize(corners.reshape(-1, 2), np.zeros(3 * len(corners)), index, texture.shape[:2])
    there = raster.covered
    vertex = parts.scan.faces[faces[raster.face[there]]]
    barycentric = raster.barycentric[there]

    def interpolated(values: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nk,nk...->n...", barycentric, values[vertex]))

    weight = interpolated(parts.on_chart.weight)
    light, sure = parts.light_at(interpolated(parts.on_chart.uv), weight, interpolated(parts.log_beyond))
    divisor, known = np.full(texture.shape, parts.light.usual), np.zeros(texture.shape[:2])
    divisor[there], known[there] = light, sure
    usable = known > 0
    albedo = texture / divisor
    if usable.any():
        rows, columns = (np.flatnonzero(usable.any(axis)) for axis in (1, 0))
        box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        none = np.zeros(there[box].shape)
        filtered = divide_light(
            texture[box], divisor[box], none, there[box], usable[box], side=parts.side, usual=usual
        )
        albedo[box] = np.where(usable[box][..., None], filtered.albedo, albedo[box])
        near = np.zeros((*texture.shape[:2], 2))
        near[there] = interpolated(parts.outlines) * np.stack([1 - weight, np.ones_like(weight)], axis=1)
        if near[..., 0].any():
            albedo[box] = without_lines(albedo[box], near[box], there[box], parts.texels_per_mm)
        usual = filtered.usual
    # Beside the scan's charts, where viewers interpolate across the rim, the light goes on.
    unlit = np.where(there[..., None], albedo, texture / _spread(divisor, there, parts.light.usual))
    return unlit * parts.light.usual, known, usual


def _spread(light: FloatArray, there: BoolArray, usual: float) -> FloatArray:
    """Return the light (H, W, 3) with the mean of its neighbours beside `there`, `usual` farther off."""
    import cv2

    window = (2 * _GUTTER + 1,) * 2
    count = cv2.boxFilter(there.astype(np.float32), -1, window)[..., None]
    total = cv2.boxFilter((light * there[..., None]).astype(np.float32), -1, window)
    return np.where(there[..., None], light, np.where(count > 1e-6, total / np.maximum(count, 1e-6), usual))
