"""`unlit_scan`: the scan as it came, its vertices, coordinates and texels, without its light; hair apart."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter
from scipy.special import expit

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.albedo.division import divide_light
from scan2albedo.albedo.noise import ChannelNoise
from scan2albedo.core import GeometryImage, RawScan
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, GridShape, IntArray, dots, smoothstep
from scan2albedo.errors import ApplicationError
from scan2albedo.face_model.materials import CLASSES
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry import rasterization
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.texture_atlas import in_first_period
from scan2albedo.unlit.face_features import FLOOR
from scan2albedo.unlit.light_beyond_face import (
    DARKEST,
    OUTSIDE_CONFIDENCE,
    SURE_HAIR,
    LightBeyond,
    SurfaceLight,
)

REACHES = ("face", "all")
"""How far the light is taken off: where the model was fitted, or from the whole scan."""
_NEAR_MM = 2.5
"""Up to this distance from the fitted surface a vertex of the scan belongs to the face, from twice as much on
not; at the model's rim the face ends gradually over four times as much."""
_HAIRS = tuple(CLASSES.index(name) for name in ("brow", "beard", "hair"))
"""Labels of what is kept apart as hair."""
_FACING = 0.3
"""Cosine between a vertex's normal and the fitted surface's from which it belongs to the face; at 0 not."""
_TILE = 1024
"""Texels of a tile's side."""
GUTTER = 16
"""Texels over which the light goes on beside charts; eight times as much is looked at beside a tile."""


@dataclass(frozen=True)
class UnlitScan:
    """A scan without its light, as bright as it was on average."""

    scan: RawScan
    """With its own vertices, faces and coordinates; its texture, or vertex colours, are unlit."""
    confidence: Float32Array
    """(H, W) of the texture, or (V,): how surely the light was taken off: 1 on the face, 0 where it was left
    in, `OUTSIDE_CONFIDENCE` beyond the face."""
    hair: Float32Array | None = None
    """(H, W), or (V,): how surely hair, beard or brows; None where there are none."""
    original: RawScan | None = None
    """The scan as it came: the colours of `hair` with its light."""


def unlit_scan(scan: RawScan, fitted: FittedFace, estimate: AlbedoEstimate, reach: str = "face") -> UnlitScan:
    """Return the scan without the light that was found on its face.

    Raises `ApplicationError` when the scan has no colour or is not where the face was fitted, or the albedo
    is of another face; `ValueError` for another `reach`.

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
    """
    require_type(scan, RawScan, "unlit_scan: scan", "load_scan(path) returns one")
    require_type(fitted, FittedFace, "unlit_scan: fitted", "fit(scan, model, pose) returns one")
    require_type(estimate, AlbedoEstimate, "unlit_scan: estimate", "estimate_albedo(image) returns one")
    if reach not in REACHES:
        raise ValueError(f"reach is {reach!r}, expected one of {', '.join(REACHES)}")
    return LightRemoval(scan, fitted, estimate).unlit(reach)


class LightRemoval:
    """Takes the light that an estimate found on a fitted face off the scan; see `unlit_scan`.

    What both reaches need is found once, when the first is asked for.
    """

    def __init__(self, scan: RawScan, fitted: FittedFace, estimate: AlbedoEstimate) -> None:
        if not scan.has_color:
            raise ApplicationError(f"{scan.name}: the scan has no colours, and so no light to take off")
        occluder = estimate.image.occluder
        if occluder is None or not np.array_equal(occluder[0], fitted.vertices):
            raise ApplicationError(
                f"{scan.name}: the albedo was estimated of another face than the fitted one"
            )
        self._scan, self._fitted, self._estimate = scan, fitted, estimate
        self._brightness = median_light(estimate)

    def unlit(self, reach: str) -> UnlitScan:
        """Return the scan without its light, on the "face" or on "all" of it."""
        scan, brightness = self._scan, self._brightness
        light = _ScanLight(*self._on_chart, self._surface.found(reach), self._charts)
        shown = np.float32(1) if scan.color_seen is None else scan.color_seen
        notes = (*scan.notes, f"the light was taken off {'the face' if reach == 'face' else 'everything'}")
        if scan.uv is not None and scan.texture_linear is not None:
            made = _unlit_texture(scan, light, brightness)
            unlit = replace(scan, texture_linear=made.color_linear, notes=notes)
        else:
            assert scan.vertex_color_linear is not None
            divisor = light.divisor(scan.vertex_color_linear)
            colors = (scan.vertex_color_linear * (brightness / divisor.color_linear)).astype(np.float32)
            made = replace(divisor, color_linear=colors)
            unlit = replace(scan, vertex_color_linear=made.color_linear, notes=notes)
        hair = made.hair if (made.hair > SURE_HAIR).any() else None
        return UnlitScan(unlit, made.confidence * shown, hair, scan)

    @cached_property
    def _on_chart(self) -> tuple[FloatArray, FloatArray]:
        """The chart's places (V, 2) nearest to the vertices, and how much (V,) these are the face's."""
        on_chart = scan_on_chart(self._scan, self._fitted, self._estimate.image)
        if not on_chart[1].any():
            where = f"{self._scan.name}: no part of it lies at the fitted face"
            raise ApplicationError(f"{where}; give the fitted scan")
        return on_chart

    @cached_property
    def _charts(self) -> FloatArray:
        """Log light, and where is hair, (H, W, 4) of the chart."""
        estimate, image, mask = self._estimate, self._estimate.image, self._estimate.image.mask
        # The light that divided the texture, with all repairs; where it was not seen none was divided.
        assert image.texture_linear is not None
        albedo = estimate.albedo_linear.astype(float)
        # The light of black texels is that of the estimate, not the quotient of two colours.
        black = FLOOR * max(float(np.median(albedo[mask])), 1e-12)
        light = (image.texture_linear + black * estimate.shading) / (albedo + black)
        light[~image.seen] = estimate.shading[~image.seen]
        log_light = np.log(np.maximum(light, DARKEST * self._brightness))
        hair = np.isin(0 if image.labels is None else image.labels, _HAIRS) & mask
        return np.dstack([filled_from_nearest(log_light, mask), hair])

    @cached_property
    def _surface(self) -> SurfaceLight:
        log_light = self._charts[..., :3]
        return SurfaceLight(
            self._scan, self._fitted, self._estimate, log_light, self._on_chart, self._brightness
        )


@dataclass(frozen=True)
class _Unlit:
    """Colours (..., 3) without their light, or the light; how surely it is off, how surely (...,) is hair."""

    color_linear: Float32Array
    confidence: Float32Array
    hair: Float32Array


@dataclass(frozen=True)
class _ScanLight:
    """The light at places (N,) on a scan: that of the chart on its face, and what goes on beyond it."""

    uv: FloatArray
    """(N, 2): the chart's places nearest to these."""
    share: FloatArray
    """(N,): how much of the light there is the chart's."""
    beyond: LightBeyond
    charts: FloatArray
    """(H, W, 4): log light, and where is hair."""

    def at(self, vertices: IntArray, barycentric: FloatArray) -> Self:
        """Return it at points of triangles (N, 3) of these places."""

        def mixed(values: FloatArray) -> FloatArray:
            return np.einsum("nk,nk...->n...", barycentric, values[vertices])

        beyond = self.beyond.interpolated(mixed)
        return replace(self, uv=mixed(self.uv), share=mixed(self.share), beyond=beyond)

    def divisor(self, color: Float32Array) -> _Unlit:
        """Return the light there (N, 3), where colours are (N, 3)."""
        on_chart = bilinear(self.charts, pixels_from_uv(self.uv, self.charts.shape[:2]))
        own, rest = self.share[:, None], 1 - self.share[:, None]
        brightness = np.log(np.maximum(color.max(-1).astype(float), FLOOR**2))
        hair = expit(self.beyond.hair_log_odds + self.beyond.hair_by_brightness * brightness)
        beyond = np.column_stack([self.beyond.log_light, hair, self.beyond.taken_off])
        found = own * np.insert(on_chart, 4, 1, axis=1) + rest * beyond
        light = np.exp(found[:, :3]).astype(np.float32)
        return _Unlit(light, found[:, 4].astype(np.float32), found[:, 3].astype(np.float32))


def median_light(estimate: AlbedoEstimate) -> float:
    """Return the light of which an unlit scan keeps the brightness: the colours' gain over the albedo."""
    image = estimate.image
    return float(np.median(estimate.shading.mean(-1)[image.seen if image.seen.any() else image.mask]))


def scan_on_chart(scan: RawScan, fitted: FittedFace, image: GeometryImage) -> tuple[FloatArray, FloatArray]:
    """Return the chart's places (V, 2) nearest to a scan's vertices, and their weights (V,) in [0, 1].

    Weight falls to 0 at the model's rim, and where the scan is far from the fitted surface, looks another
    way, or was left out of the fit (`FittedFace.covered_faces`).
    """
    vertices, far_mm = transform_points(fitted.model_from_scan, scan.vertices), 2 * _NEAR_MM
    low, high = fitted.vertices.min(0) - far_mm, fitted.vertices.max(0) + far_mm
    near = np.flatnonzero(((vertices > low) & (vertices < high)).all(1))
    uv, weight = np.full((len(vertices), 2), 0.5), np.zeros(len(vertices))
    if len(near) == 0:
        return uv, weight
    hits = surface_query(fitted.vertices, fitted.faces).query(vertices[near])
    uv[near] = hits.interpolated(fitted.uv, fitted.faces)
    across = hits.interpolated(vertex_normals(fitted.vertices, fitted.faces), fitted.faces)
    cosine = dots(across, vertex_normals(vertices, scan.faces)[near])
    areas = image.texel_areas_mm2()
    texel_mm = float(np.sqrt(np.median(areas))) if len(areas) else 0.0
    inside = distance_transform_edt(np.pad(image.mask, 1))[1:-1, 1:-1, None]
    from_rim_mm = texel_mm * bilinear(inside, pixels_from_uv(uv[near], image.shape))[:, 0]
    weight[near] = smoothstep((far_mm - hits.distance) / (far_mm - _NEAR_MM))
    weight[near] *= smoothstep(cosine / _FACING) * smoothstep(from_rim_mm / (2 * far_mm))
    if fitted.covered_faces is not None and len(fitted.covered_faces) == len(scan.faces):
        weight[scan.faces[fitted.covered_faces]] = 0.0
    return uv, weight


def _unlit_texture(scan: RawScan, light: _ScanLight, brightness: float) -> _Unlit:
    """Return a scan's texture without the light of its vertices; colours stay where none is known."""
    texture, uv = scan.texture_linear, scan.uv
    assert texture is not None
    assert uv is not None
    shape = texture.shape[:2]
    corners = pixels_from_uv(in_first_period(uv, texture.shape).reshape(-1, 2), shape).reshape(-1, 3, 2)
    first, last = np.floor(corners.min(1)), np.ceil(corners.max(1))
    made = _Unlit(np.array(texture), *np.zeros((2, *shape), np.float32))
    margin = 8 * GUTTER
    noise: ChannelNoise | None = None
    for top, left in _tiles(shape, corners.mean(1)[(light.share[scan.faces] > 0).any(1)]):
        low = np.maximum([left - margin, top - margin], 0)
        high = np.minimum([left + _TILE + margin, top + _TILE + margin], [shape[1], shape[0]])
        inside = np.flatnonzero(((last >= low) & (first <= high)).all(1))
        if len(inside) == 0:
            continue
        tile = texture[low[1] : high[1], low[0] : high[0]]
        places_px = (corners[inside] - low).reshape(-1, 2)
        index = np.arange(len(places_px)).reshape(-1, 3)
        raster = rasterization.rasterize(places_px, np.zeros(len(places_px)), index, tile.shape[:2])
        there = raster.covered
        of_texels = light.at(scan.faces[inside[raster.face[there]]], raster.barycentric[there])
        taken = of_texels.divisor(tile[there])
        divisor = np.full(tile.shape, brightness)
        known, hair = np.zeros((2, *tile.shape[:2]))
        divisor[there] = taken.color_linear
        known[there] = taken.confidence
        hair[there] = taken.hair
        usable, albedo = known >= OUTSIDE_CONFIDENCE, tile / divisor
        if usable.any():
            rows, columns = (np.flatnonzero(usable.any(axis)) for axis in (1, 0))
            box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            dark = np.zeros(there[box].shape)  # no highlight
            filtered = divide_light(tile[box], divisor[box], dark, there[box], usable[box], image_noise=noise)
            albedo[box] = np.where(usable[box][..., None], filtered.albedo, albedo[box])
            noise = filtered.noise
            _take_off_outlines(albedo, there, of_texels)
        # Beside the scan's charts, where viewers interpolate across the rim, all goes on.
        dilated = maximum_filter(there, 2 * GUTTER + 1)
        filled = filled_from_nearest(np.dstack([albedo, hair]), there)
        unlit = np.where(dilated[..., None], filled[..., :3], tile / brightness) * brightness
        target = np.s_[top : top + _TILE, left : left + _TILE]
        own = np.s_[top - low[1] : top - low[1] + _TILE, left - low[0] : left - low[0] + _TILE]
        made.color_linear[target] = unlit[own]
        made.confidence[target] = known[own]
        made.hair[target] = np.where(dilated, filled[..., 3], 0)[own]
    return made


def _tiles(shape: GridShape, face: FloatArray) -> list[tuple[int, int]]:
    """Return the upper left corners of a texture's tiles; that with most of the `face` (N, 2) comes first.

    What is usual there serves for all, so that they join without a seam.
    """
    places = (np.clip(face[:, ::-1], 0, np.array(shape) - 1) // _TILE).astype(int) * _TILE
    count = Counter(map(tuple, places.tolist()))
    tiles = [(top, left) for top in range(0, shape[0], _TILE) for left in range(0, shape[1], _TILE)]
    return sorted(tiles, key=lambda tile: -count[tile])


def _take_off_outlines(albedo: FloatArray, there: BoolArray, light: _ScanLight) -> None:
    """Lower what stands out of the albedo (H, W, 3) beside a shadow's outline: there (H, W) is `light`.

    A deviation from skin that is greater than detail's is the outline's.
    """
    beyond = light.beyond
    if beyond.steepness.any():
        off = np.log(np.maximum(albedo[there], FLOOR)) - beyond.skin
        twice = 2 * beyond.detail
        excess = np.maximum(np.minimum(np.abs(off), beyond.steepness[:, None]) / twice, 1.0)
        albedo[there] *= np.exp((1 - light.share[:, None]) * off * (excess**-2 - 1))
