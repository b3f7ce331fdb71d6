"""`unlit_scan`: the scan as it came, its vertices, coordinates and texels, without its light and outlines."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, maximum_filter, uniform_filter
from scipy.spatial import cKDTree
from skimage.filters.rank import median

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.albedo.division import divide_light
from scan2albedo.albedo.noise import ChannelNoise
from scan2albedo.albedo.result import shade_image
from scan2albedo.applications.face_features import AROUND, FLOOR
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, on_grid, smoothstep
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import ApplicationError
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry import rasterization
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import edges_with_faces, face_areas, thinned, vertex_normals
from scan2albedo.geometry.parametrization import signed_areas
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.texture_atlas import in_first_period

REACHES = ("face", "all")
"""How far the light is taken off: where the model was fitted, or from the whole scan."""
OUTSIDE_CONFIDENCE = 0.5
"""Relative to the face: beyond the model the light is that of its lamps on the scan's own, rougher shape."""
DARKEST = 0.1
"""Least light that divides, as a part of the usual: less makes noise bright, more leaves deep shadows dark
(`tools/bench_unlit.py traced`)."""
_DARK_SPOT = 0.7
"""How much darker a spot is than around, as a logarithm: by eye, on the folded lips of a coarse template."""
_NEAR_MM = 2.5
"""Up to this distance from the fitted surface a vertex of the scan belongs to the face, from twice as much on
not; at the model's rim the face ends gradually over four times as much. Beyond the face light is found on the
scan with so much between its vertices."""
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
    confidence: NDArray[np.float32]
    """(H, W) of the texture, or (V,): how surely the light was taken off: 1 on the face, 0 where it was left
    in, `OUTSIDE_CONFIDENCE` beyond the face."""


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
    if not scan.has_color:
        raise ApplicationError(f"{scan.name}: the scan has no colours, and so no light to take off")
    occluder = estimate.image.occluder
    if occluder is None or not np.array_equal(occluder[0], fitted.vertices):
        raise ApplicationError(f"{scan.name}: the albedo was estimated of another face than the fitted one")
    image, mask = estimate.image, estimate.image.mask
    uv, weight = scan_on_chart(scan, fitted, image)
    if not weight.any():
        raise ApplicationError(f"{scan.name}: no part of it lies at the fitted face; give the fitted scan")
    # The light that divided the texture, with all repairs; where it was not seen none was divided.
    assert image.texture_linear is not None
    albedo = estimate.albedo_linear.astype(np.float64)
    usual = usual_light(estimate)
    # The light of black texels is that of the estimate, not the quotient of two colours.
    black = FLOOR * max(float(np.median(albedo[mask])), 1e-12)
    light = (image.texture_linear + black * estimate.shading) / (albedo + black)
    light[~image.seen] = estimate.shading[~image.seen]
    log_light = np.log(np.maximum(light, DARKEST * usual))
    log_light = _without_dark_spots(filled_from_nearest(log_light, mask))
    log_beyond, steps = np.full((len(scan.vertices), 3), math.log(usual)), np.zeros((len(scan.vertices), 2))
    if reach == "all":
        # Light of the estimate's lamps and environment on the scan's own shape, and its outlines.
        vertices = transform_points(fitted.model_from_scan, scan.vertices)
        thin = thinned(vertices, scan.faces, _NEAR_MM)
        if len(thin.faces) == 0:
            thin = thinned(vertices, scan.faces, 0.0)
        normals = vertex_normals(thin.vertices, thin.faces)
        lit = shade_image(
            GeometryImage(thin.vertices[None], normals[None], np.ones((1, len(thin.vertices)), bool)),
            estimate.lights,
            estimate.reflectance,
            estimate.view_direction,
            RayCaster(thin.vertices, thin.faces) if estimate.casts_shadows else None,
            estimate.shadow_offset_mm,
            estimate.environment,
        ).light_linear
        log_lit = np.log(np.maximum(lit, DARKEST * usual))
        hits = surface_query(thin.vertices, thin.faces).query(vertices)
        log_beyond = hits.interpolated(log_lit, thin.faces)
        steps = outlines(thin.vertices, thin.faces, log_lit, vertices)
    # How fine the scan's texture is on the face.
    density, own = 0.0, (weight[scan.faces] > 0).all(1)
    if scan.texture_linear is not None and scan.uv is not None and own.any():
        pixels = pixels_from_uv(scan.uv[own].reshape(-1, 2), scan.texture_linear.shape[:2])
        texels = np.abs(signed_areas(pixels, np.arange(len(pixels)).reshape(-1, 3))).sum()
        density = float(np.sqrt(texels / max(face_areas(scan.vertices, scan.faces[own]).sum(), 1e-12)))
    outside = OUTSIDE_CONFIDENCE if reach == "all" else 0.0

    def light_at(place: FloatArray, share: FloatArray, beyond: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the light (N, 3), by `share` (N,) the chart's, and how surely it is known (N,)."""
        on_chart = bilinear(log_light, pixels_from_uv(place, mask.shape))
        log_there = share[:, None] * on_chart + (1 - share[:, None]) * beyond
        return np.exp(log_there), share + (1 - share) * outside

    shown = np.float32(1) if scan.color_seen is None else scan.color_seen
    notes = (*scan.notes, f"the light was taken off {'the face' if reach == 'face' else 'everything'}")
    if scan.uv is not None and scan.texture_linear is not None:
        of_vertices = weight, uv, log_beyond, steps
        texture, confidence = _unlit_texture(scan, light_at, usual, of_vertices, density)
        return UnlitScan(replace(scan, texture_linear=texture, notes=notes), confidence * shown)
    assert scan.vertex_color_linear is not None
    divisor, sure = light_at(uv, weight, log_beyond)
    colors = (scan.vertex_color_linear * (usual / divisor)).astype(np.float32)
    return UnlitScan(replace(scan, vertex_color_linear=colors, notes=notes), sure.astype(np.float32) * shown)


def usual_light(estimate: AlbedoEstimate) -> float:
    """Return the light of which an unlit scan keeps the brightness: the colours' gain over the albedo."""
    image = estimate.image
    return float(np.median(estimate.shading.mean(-1)[image.seen if image.seen.any() else image.mask]))


def _without_dark_spots(log_light: FloatArray) -> FloatArray:
    """Return log light (H, W, 3) without small spots much darker than around: folds of the surface."""
    mean = log_light.mean(-1)
    side = 2 * round(AROUND * max(mean.shape)) + 1
    low, high = float(mean.min()), float(mean.max())
    steps = np.round((mean - low) * (255 / max(high - low, 1e-9))).astype(np.uint8)
    around = low + median(steps, np.ones((side, side))) * ((high - low) / 255)
    return log_light + np.maximum(around - _DARK_SPOT - mean, 0.0)[..., None]


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
    cosine = np.einsum("nc,nc->n", across, vertex_normals(vertices, scan.faces)[near])
    areas = image.texel_areas_mm2()
    texel_mm = float(np.sqrt(np.median(areas))) if len(areas) else 0.0
    inside = distance_transform_edt(np.pad(image.mask, 1))[1:-1, 1:-1, None]
    from_rim_mm = texel_mm * bilinear(inside, pixels_from_uv(uv[near], image.shape))[:, 0]
    weight[near] = smoothstep((far_mm - hits.distance) / (far_mm - _NEAR_MM))
    weight[near] *= smoothstep(cosine / _FACING) * smoothstep(from_rim_mm / (2 * far_mm))
    if fitted.covered_faces is not None and len(fitted.covered_faces) == len(scan.faces):
        weight[scan.faces[fitted.covered_faces]] = 0.0
    return uv, weight


def _unlit_texture(
    scan: RawScan,
    light_at: Callable[..., tuple[FloatArray, FloatArray]],
    brightness: float,
    vertices: tuple[FloatArray, ...],
    texels_per_mm: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return a scan's texture (H, W, 3) without its light, or as it is where no face is, and the confidence.

    `vertices` belong to the chart by weight (V,), lie at its uv (V, 2), and have beyond it log light (V, 3),
    about `brightness`, with outlines (V, 2).
    """
    texture, uv = scan.texture_linear, scan.uv
    assert texture is not None
    assert uv is not None
    shape = texture.shape[:2]
    corners = pixels_from_uv(in_first_period(uv, texture.shape).reshape(-1, 2), shape).reshape(-1, 3, 2)
    first, last = np.floor(corners.min(1)), np.ceil(corners.max(1))
    result, confidence, margin = np.array(texture), np.zeros(shape, np.float32), 8 * GUTTER
    # The tile with most of the face comes first: what is usual there serves for all, so that they join
    # without a seam.
    face = corners.mean(1)[(vertices[0][scan.faces] > 0).any(1)]
    places = (np.clip(face[:, ::-1], 0, np.array(shape) - 1) // _TILE).astype(np.int64) * _TILE
    count = Counter(map(tuple, places.tolist()))
    tiles = [(top, left) for top in range(0, shape[0], _TILE) for left in range(0, shape[1], _TILE)]
    usual: ChannelNoise | None = None
    for top, left in sorted(tiles, key=lambda tile: -count[tile]):
        low = np.maximum([left - margin, top - margin], 0)
        high = np.minimum([left + _TILE + margin, top + _TILE + margin], [shape[1], shape[0]])
        inside = np.flatnonzero(((last >= low) & (first <= high)).all(1))
        if len(inside) == 0:
            continue
        tile = texture[np.s_[low[1] : high[1], low[0] : high[0]]]
        places_px = (corners[inside] - low).reshape(-1, 2)
        index = np.arange(len(places_px)).reshape(-1, 3)
        raster = rasterization.rasterize(places_px, np.zeros(len(places_px)), index, tile.shape[:2])
        there = raster.covered
        vertex, barycentric = scan.faces[inside[raster.face[there]]], raster.barycentric[there]
        weight, place, beyond, near_outlines = (
            np.asarray(np.einsum("nk,nk...->n...", barycentric, values[vertex])) for values in vertices
        )
        divisor, known = np.full(tile.shape, brightness), np.zeros(tile.shape[:2])
        divisor[there], known[there] = light_at(place, weight, beyond)
        usable, albedo = known > 0, tile / divisor
        if usable.any():
            rows, columns = (np.flatnonzero(usable.any(axis)) for axis in (1, 0))
            box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            dark = np.zeros(there[box].shape)  # no highlight
            filtered = divide_light(tile[box], divisor[box], dark, there[box], usable[box], usual=usual)
            albedo[box] = np.where(usable[box][..., None], filtered.albedo, albedo[box])
            near = on_grid(there, near_outlines * np.stack([1 - weight, np.ones_like(weight)], axis=1))
            if near[..., 0].any():
                albedo[box] = without_lines(albedo[box], near[box], there[box], texels_per_mm)
            usual = filtered.noise
        # Beside the scan's charts, where viewers interpolate across the rim, its colours go on.
        beside = maximum_filter(there, 2 * GUTTER + 1)[..., None]
        unlit = np.where(beside, filled_from_nearest(albedo, there), tile / brightness) * brightness
        own = np.s_[top - low[1] : top - low[1] + _TILE, left - low[0] : left - low[0] + _TILE]
        result[top : top + _TILE, left : left + _TILE] = unlit[own]
        confidence[top : top + _TILE, left : left + _TILE] = known[own]
    return result, confidence


_STEEP = 0.08
"""Change of log light in a mm of the surface from which there is an outline."""
_LINE_NEAR_MM = 3.0
"""Up to this distance from an outline colours are doubtful; from twice as much on not at all."""
_DETAIL_MM = 0.7
"""Standard deviation of the mean that detail is what is left of."""
_LEAST_KNOWN = 0.05
"""Part of what is around a texel that has to be known."""
_ALIKE, _UNLIKE = 0.12, 0.25
"""Deviation of log V around a texel up to which all of it is one material, and from which it is not."""
_DARK = 1e-4
"""Albedo below which no logarithm is taken."""


def outlines(vertices: FloatArray, faces: IntArray, log_light: FloatArray, points: FloatArray) -> FloatArray:
    """Return (N, 2) how near points are to outlines of log light (V, 3), 0 to 1, and their steps."""
    ends, _ = edges_with_faces(faces)
    first, second = vertices[ends[:, 0]], vertices[ends[:, 1]]
    value = log_light.mean(-1)
    steep = np.abs(value[ends[:, 0]] - value[ends[:, 1]]) > _STEEP * np.linalg.norm(second - first, axis=1)
    found = np.zeros((len(points), 2))
    if not steep.any():
        return found
    low, high = value.copy(), value.copy()
    for _ in range(3):  # edges from one end of an outline's step to its middle
        for here, there in (ends.T, ends.T[::-1]):
            np.minimum.at(low, here, low[there])
            np.maximum.at(high, here, high[there])
    middle = (first[steep] + second[steep]) / 2
    distance, nearest = cKDTree(middle).query(points, distance_upper_bound=2 * _LINE_NEAR_MM)
    within = np.isfinite(distance)
    found[:, 0] = np.clip(2 - distance / _LINE_NEAR_MM, 0.0, 1.0)
    found[within, 1] = (high - low)[ends[steep, 0]][nearest[within]]
    return found


def without_lines(
    albedo: FloatArray, outlines: FloatArray, there: BoolArray, texels_per_mm: float
) -> NDArray[np.float32]:
    """Return an unlit texture (H, W, 3) whose colours go on across `outlines` (H, W, 2), see there.

    No colour changes by more than the light does there, for that is all a misplaced outline can do. Only
    texels that are `there` (H, W) count.
    """
    near, step = np.moveaxis(outlines, -1, 0)
    known = there & (near <= 0)
    log_albedo = np.log(np.maximum(albedo, _DARK)).astype(np.float32)
    if not known.any() or not (there & (near > 0)).any():
        return albedo.astype(np.float32)

    def blurred(values: NDArray[np.float32]) -> NDArray[np.float32]:
        sigma = _DETAIL_MM * texels_per_mm
        return gaussian_filter(values, (sigma, sigma, 0), mode="mirror")

    inside = there[..., None].astype(np.float32)
    mean = blurred(log_albedo * inside) / np.maximum(blurred(inside), 1e-6)
    base = blurred(rasterization.filled_smoothly(log_albedo, known))
    detail = log_albedo - mean
    # Detail of more than four times the median is a remainder of an outline.
    usual = 4 * float(np.median(np.abs(detail[known])))
    # How alike what is known is 16 mm around each texel: not hair, or hair and skin.
    side, value = 2 * max(1, round(16 * texels_per_mm)) + 1, mean.max(-1)
    part, first, second = (
        uniform_filter(field, side, mode="mirror")
        for field in (known * 1.0, known * value.astype(np.float64), known * value.astype(np.float64) ** 2)
    )
    around, square = np.stack([first, second]) / np.maximum(part, 1e-6)
    deviation = np.sqrt(np.maximum(square - around**2, 0.0))
    alike = np.where(part > _LEAST_KNOWN, np.clip((_UNLIKE - deviation) / (_UNLIKE - _ALIKE), 0.0, 1.0), 0.0)
    share = (near * there * alike)[..., None]
    limit = step[..., None]
    wanted = mean + (base - mean).clip(-limit, limit) + detail.clip(-usual, usual)
    return np.exp((1 - share) * log_albedo + share * wanted).astype(np.float32)
