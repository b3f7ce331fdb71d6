"""`unlit_scan`: the scan as it came, its vertices, coordinates and texels, without its light; hair apart."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import distance_transform_edt, maximum_filter
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from scipy.special import expit, logit
from skimage.filters.rank import median

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.albedo.division import divide_light
from scan2albedo.albedo.noise import ChannelNoise
from scan2albedo.albedo.result import shade_image
from scan2albedo.applications.face_features import AROUND, FLOOR
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import FloatArray, smoothstep
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import ApplicationError
from scan2albedo.face_model.appearance import CLASSES, PATCH_MM, beyond_chart
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry import rasterization
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import adjacency, neighbour_mean, thinned, usual_edge, vertex_normals
from scan2albedo.geometry.operators import filled_over_mesh
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv, scan_colors
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
_HAIRS = tuple(CLASSES.index(name) for name in ("brow", "beard", "hair"))
_FAR_MM, _EVEN_MM = 25.0, 10.0
"""Over so much of the surface what was found at the face's rim fades to a part of 1/e; skin's albedo, and the
light on hair, change little over so much."""
_OWN = 0.2
"""Deviation of skin's log albedo beyond the face: of that the model's light leaves, half is its own, and the
less the more it is beyond this."""
_WHITE = 1.4
"""By so much is log albedo at most above that of skin, on average: white cloth is four times as bright."""
SURE_HAIR = 0.5
"""Where nothing is hair more surely, there is none."""
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
    hair: NDArray[np.float32] | None = None
    """(H, W), or (V,): how surely hair, beard or brows; None where there are none."""
    lit: RawScan | None = None
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
    beyond, darker, detail = _beyond_face(scan, fitted, estimate, log_light, (uv, weight), usual, reach)
    hair_on_chart = np.isin(0 if image.labels is None else image.labels, _HAIRS) & mask
    charts = np.dstack([log_light, hair_on_chart])

    def taken_off(
        color: FloatArray, place: FloatArray, share: FloatArray, known: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the light (N, 3), by `share` (N,) the chart's, how surely it is known, and hair."""
        on_chart, own = bilinear(charts, pixels_from_uv(place, mask.shape)), share[:, None]
        log_there = own * on_chart[:, :3] + (1 - own) * known[:, :3]
        odds = known[:, 8] + darker * np.log(np.maximum(color.max(-1), FLOOR * black))
        hair = share * on_chart[:, 3] + (1 - share) * expit(odds)
        return np.exp(log_there), share + (1 - share) * known[:, 3], hair

    shown = np.float32(1) if scan.color_seen is None else scan.color_seen
    notes = (*scan.notes, f"the light was taken off {'the face' if reach == 'face' else 'everything'}")
    if scan.uv is not None and scan.texture_linear is not None:
        texture, confidence, hair = _unlit_texture(scan, taken_off, usual, (uv, weight, beyond), detail)
        unlit = replace(scan, texture_linear=texture, notes=notes)
    else:
        assert scan.vertex_color_linear is not None
        divisor, sure, hairy = taken_off(scan.vertex_color_linear.astype(np.float64), uv, weight, beyond)
        colors = scan.vertex_color_linear * (usual / divisor)
        unlit = replace(scan, vertex_color_linear=colors.astype(np.float32), notes=notes)
        confidence, hair = sure.astype(np.float32), hairy.astype(np.float32)
    return UnlitScan(unlit, confidence * shown, hair if (hair > SURE_HAIR).any() else None, scan)


def _beyond_face(
    scan: RawScan,
    fitted: FittedFace,
    estimate: AlbedoEstimate,
    log_light: FloatArray,
    on_chart: tuple[FloatArray, FloatArray],
    usual: float,
    reach: str,
) -> tuple[FloatArray, float, float]:
    """Return what is known of a scan's vertices beyond the face (V, 9), and two numbers for their texels.

    Columns: log light (3), how surely it is taken off, skin's expected log albedo (3), by how much log light
    changes beside it, log odds of hair. The numbers: the weight of a texel's log brightness in these odds,
    and twice the deviation of skin's usual detail. `on_chart` are places (V, 2) and weights (V,).

    The light is a base (the usual one, or that of the estimate's lamps on the scan's own shape) plus an
    offset o, the least of

        sum_ij w_ij |o_i - o_j|^2 + sum_i p |o_i|^2 + sum_i d_i |o_i - r_i|^2

    over the edges ij of the scan's mesh, equal to that of the chart on the face (a screened membrane). Its
    links w hold where both ends are skin, or both are not. Where light is taken off everywhere, r is what the
    colour of skin differs by from the expected; d is small for detail and large for outlines of shadows.
    """
    image, vertices = estimate.image, transform_points(fitted.model_from_scan, scan.vertices)
    thin = thinned(vertices, scan.faces, _NEAR_MM)
    if len(thin.faces) == 0:
        thin = thinned(vertices, scan.faces, 0.0)
    points, faces, count = thin.vertices, thin.faces, len(thin.vertices)
    normals, edge_mm = vertex_normals(points, faces), usual_edge(points, faces) or 1.0
    tree, mean, graph = cKDTree(points), neighbour_mean(count, faces), adjacency(count, faces).tocoo()
    nearest = cKDTree(vertices).query(points)[1]
    pixels = pixels_from_uv(on_chart[0][nearest], image.shape)
    inside, chart = on_chart[1][nearest], bilinear(log_light, pixels)
    known = inside >= 0.5
    # Colours are means of points inside of faces: beside the texture's charts is no colour.
    some = np.repeat(np.arange(0, len(scan.faces), 1 + len(scan.faces) // 100_000), 3)
    corners = np.tile(np.eye(3) / 2 + 1 / 6, (len(some) // 3, 1))
    color, shown = scan_colors(scan, some, corners)
    shown |= not shown.any()
    at = tree.query(np.einsum("nk,nkc->nc", corners, vertices[scan.faces[some]]))[1]
    total = np.stack([np.bincount(at, shown * each, count) for each in (*color.T, np.ones(len(at)))], axis=1)
    color = filled_over_mesh(total[:, :3] / np.maximum(total[:, 3:], 1), total[:, 3] > 0, faces)
    log_color = np.log(np.maximum(color, FLOOR * max(np.percentile(color, 95), FLOOR)))
    lit = shade_image(
        GeometryImage(points[None], normals[None], np.ones((1, count), bool)), estimate.lights,
        estimate.reflectance, estimate.view_direction,
        RayCaster(points, faces) if estimate.casts_shadows else None, estimate.shadow_offset_mm,
        estimate.environment,
    ).light_linear.reshape(-1, 3)  # fmt: skip
    log_lit = np.log(np.maximum(lit, DARKEST * usual))
    # What is hair, or cloth; what was left out of the fit is neither that nor skin.
    on_skin = image.seen * 1.0 if image.skin is None else image.skin
    skin = inside * bilinear(filled_from_nearest(on_skin[..., None], image.mask), pixels)[:, 0]
    hair = other = np.zeros(count)
    few = np.zeros(image.shape, bool)
    few[:: -(-image.shape[0] // 128), :: -(-image.shape[1] // 128)] = True
    few &= image.mask if image.on_face is None else image.mask & image.on_face
    if image.face_chart is not None and few.any():
        closest = cKDTree(image.position[few]).query(points)[1]
        where = skin, image.face_chart[few][closest], points - image.position[few][closest]
        shares = beyond_chart(log_color - log_lit, normals, *where, mean, (edge_mm / PATCH_MM) ** 2)
        hair, other = shares[-2], shares[-2:].sum(0)
    covered = np.zeros(len(vertices), bool)
    if fitted.covered_faces is not None and len(fitted.covered_faces) == len(scan.faces):
        covered[scan.faces[fitted.covered_faces]] = True
    apart = covered[nearest]
    other = np.where(apart, 1.0, other)
    # Between hair and skin the texel decides by how bright it is, relative to the means of both.
    bright, weight = log_color.max(-1), 0.0
    if hair.max() > SURE_HAIR:
        parts, own = (hair, np.maximum(1 - other, FLOOR)), bright - log_lit.max(-1)
        of_hair, of_skin = (np.average(own, weights=part) for part in parts)
        weight = (of_hair - of_skin) / (sum(np.cov(own, aweights=part) for part in parts) + _OWN**2)
    log_odds = logit(np.clip(hair, FLOOR**2, 1 - FLOOR**2)) - weight * bright

    rows, (i, j) = np.flatnonzero(~known), (graph.row, graph.col)
    alike = ((1 - other[i]) * (1 - other[j]) + other[i] * other[j]) * ~(apart[i] | apart[j])
    links = sparse.csr_matrix((alike, (i, j)), (count, count))
    degree = np.asarray(links.sum(1)).ravel()

    def solved(values: FloatArray, pull: FloatArray, toward: FloatArray) -> FloatArray:
        """Return `values` (N, C) where they are known, and where not what goes on from there."""
        system = (sparse.diags(degree + pull) - links).tocsr()[rows]
        right = pull[rows, None] * toward[rows] - system[:, known] @ values[known]
        found = values.copy()
        if len(rows):
            found[rows] = splu(system[:, rows].tocsc()).solve(right)
        return found

    # On a mesh of even triangles the sum over six edges is 3/2 edge^2 times the Laplacian.
    fading, even = (np.full(count, 1.5 * (edge_mm / over) ** 2) for over in (_FAR_MM, _EVEN_MM))
    expected, steep, detail, one = np.zeros((count, 3)), np.zeros(count), 1.0, np.ones((count, 1))
    if reach == "face":
        base = np.full((count, 3), math.log(usual))
        found = solved(np.hstack([chart - base, one]), fading, np.zeros((count, 4)))
        found *= found[:, 3:] > 2 / 255  # the least that a picture of the confidence shows
    else:
        # Hair's and cloth's light is even. Skin's albedo goes on from the rim, then is half of what is left.
        smooth = log_lit
        for _ in range(round(min(2 * (_EVEN_MM / edge_mm) ** 2, count))):
            smooth = mean @ smooth
        base = log_lit + other[:, None] * (smooth - log_lit)
        usual_skin = np.average(log_color - chart, axis=0, weights=skin + FLOOR)
        left = log_color - base - usual_skin
        own = solved(
            log_color - chart - usual_skin, even, (1 - other[:, None]) * left / (2 + (left / _OWN) ** 2)
        )
        expected, wrong = usual_skin + own, (1 - other[:, None]) * (left - own)
        wrong += other[:, None] * np.maximum(left.mean(-1, keepdims=True) - _WHITE, 0)
        # What stands out from around by more than detail does is a misplaced outline of light.
        around = wrong
        for _ in range(8):
            around = mean @ around
        fine = np.abs(wrong - around).max(-1)
        sure = ~known & (other < SURE_HAIR)
        detail = max(float(np.median(fine[sure])) if sure.any() else 1.0, FLOOR)
        trust = even * (other + (1 - other) * (1 - mean @ other) * (1 + (fine / detail) ** 2))
        toward = np.hstack([wrong * (trust / (fading + trust))[:, None], 0 * one])
        found = solved(np.hstack([chart - base, one]), fading + trust, toward)
        found[:, 3] = 1
        np.maximum.at(steep, i, np.abs((base + found[:, :3])[i] - (base + found[:, :3])[j]).max(-1))
        steep *= 1 - other
    fields = base + found[:, :3], OUTSIDE_CONFIDENCE * found[:, 3], expected, steep, log_odds
    nearby = surface_query(points, faces).query(vertices)
    return nearby.interpolated(np.column_stack(fields), faces), weight, 2 * detail


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
    taken_off: Callable[..., tuple[FloatArray, ...]],
    brightness: float,
    vertices: tuple[FloatArray, FloatArray, FloatArray],
    detail: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return a scan's texture (H, W, 3) without its light, how surely it is off, and how surely it is hair.

    `vertices` lie at the chart's uv (V, 2), belong to it by weight (V,), and `_beyond_face` (V, 9) it. Where
    nothing is known colours stay as they are.
    """
    texture, uv = scan.texture_linear, scan.uv
    assert texture is not None
    assert uv is not None
    shape = texture.shape[:2]
    corners = pixels_from_uv(in_first_period(uv, texture.shape).reshape(-1, 2), shape).reshape(-1, 3, 2)
    first, last = np.floor(corners.min(1)), np.ceil(corners.max(1))
    result, margin = np.array(texture), 8 * GUTTER
    confidence, hair = np.zeros((2, *shape), np.float32)
    # The tile with most of the face comes first: what is usual there serves for all, so that they join
    # without a seam.
    face = corners.mean(1)[(vertices[1][scan.faces] > 0).any(1)]
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
        place, weight, beyond = (
            np.asarray(np.einsum("nk,nk...->n...", barycentric, values[vertex])) for values in vertices
        )
        divisor, (known, hairy) = np.full(tile.shape, brightness), np.zeros((2, *tile.shape[:2]))
        divisor[there], known[there], hairy[there] = taken_off(
            tile[there].astype(np.float64), place, weight, beyond
        )
        usable, albedo = known >= OUTSIDE_CONFIDENCE, tile / divisor
        if usable.any():
            rows, columns = (np.flatnonzero(usable.any(axis)) for axis in (1, 0))
            box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            dark = np.zeros(there[box].shape)  # no highlight
            filtered = divide_light(tile[box], divisor[box], dark, there[box], usable[box], usual=usual)
            albedo[box] = np.where(usable[box][..., None], filtered.albedo, albedo[box])
            usual = filtered.noise
            if beyond[:, 7].any():
                # Beside a shadow's outline a deviation greater than detail's is the outline's.
                off = np.log(np.maximum(albedo[there], FLOOR)) - beyond[:, 4:7]
                excess = np.maximum(np.minimum(np.abs(off), beyond[:, 7:8]) / detail, 1.0)
                albedo[there] *= np.exp((1 - weight[:, None]) * off * (excess**-2 - 1))
        # Beside the scan's charts, where viewers interpolate across the rim, all goes on.
        beside = maximum_filter(there, 2 * GUTTER + 1)[..., None]
        filled = filled_from_nearest(np.dstack([albedo, hairy]), there)
        unlit = np.where(beside, filled[..., :3], tile / brightness) * brightness
        hairy = np.where(beside[..., 0], filled[..., 3], 0)
        own = np.s_[top - low[1] : top - low[1] + _TILE, left - low[0] : left - low[0] + _TILE]
        result[top : top + _TILE, left : left + _TILE] = unlit[own]
        confidence[top : top + _TILE, left : left + _TILE] = known[own]
        hair[top : top + _TILE, left : left + _TILE] = hairy[own]
    return result, confidence, hair
