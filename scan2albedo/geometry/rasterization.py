"""Triangles to pixels and back; images between pixels, and made smaller; a coloured scan seen along -z."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    GridShape,
    IntArray,
    NDArray,
    RealArray,
    dots,
    norms,
    triangle_sides,
)
from scan2albedo.core.compiled import compiled, triple
from scan2albedo.geometry.rigid import transform_points


@dataclass(frozen=True)
class Raster:
    """`face` (H, W) int64 with -1 where nothing covers; `barycentric` (H, W, 3) float64, zeros there."""

    face: IntArray
    barycentric: FloatArray

    @property
    def covered(self) -> BoolArray:
        """(H, W) True where a face covers the pixel centre."""
        return self.face >= 0


def rasterize_uv(uv: ArrayLike, faces: ArrayLike, size: int | tuple[int, int]) -> Raster:
    """Rasterise a chart (V, 2) over the unit square to (size, size) or (H, W) texels.

    Texel (row r, column c) has its centre at u = (c + 1/2) / W, v = 1 - (r + 1/2) / H: row 0 is the top.
    `faces` (F, 3) are indices into `uv`.
    """
    height, width = size if isinstance(size, tuple) else (int(size), int(size))
    pixels = pixels_from_uv(uv, (height, width))
    return rasterize(pixels, np.zeros(len(pixels)), faces, (height, width))


def pixels_from_uv(uv: ArrayLike, shape: GridShape) -> FloatArray:
    """Return (N, 2) pixel coordinates (column, row), pixel centres at integers, of texture coordinates."""
    coordinates = np.asarray(uv, float)
    return np.stack([coordinates[:, 0] * shape[1] - 0.5, (1 - coordinates[:, 1]) * shape[0] - 0.5], 1)


def rasterize(pixels: ArrayLike, depth: ArrayLike, faces: ArrayLike, shape: GridShape) -> Raster:
    """Rasterise triangles with a z-buffer; the largest depth (V,) wins, whatever the winding.

    `pixels` (V, 2) are column and row of each vertex; pixel centres lie at integers.
    """
    raster = Raster(np.full(shape, -1, int), np.zeros((*shape, 3)))
    nearest_depths(pixels, depth, faces, shape, raster)
    return raster


def nearest_depths(
    pixels: ArrayLike,
    depth: ArrayLike,
    faces: ArrayLike,
    shape: GridShape,
    raster: Raster = Raster(np.zeros((0, 0), int), np.zeros((0, 0, 3))),
) -> FloatArray:
    """Return the largest depth (H, W) at each pixel centre, -inf where nothing covers it; fill a `raster`."""
    places, depths = np.ascontiguousarray(pixels, float), np.ascontiguousarray(depth, float)
    triangles, nearest = np.ascontiguousarray(faces, int), np.full(shape, -np.inf)
    _rasterize(places, depths, triangles, nearest, raster.face, raster.barycentric)
    return nearest


@compiled
def _rasterize(pixels, depth, faces, nearest, owner, weights):  # type: ignore[no-untyped-def]
    """Fill `nearest` (H, W), -inf before, and unless empty `owner` (H, W) and `weights` (H, W, 3)."""
    height, width = nearest.shape
    owned = owner.size > 0
    for f in range(faces.shape[0]):
        a, b, c = triple(faces, f)
        ax, ay = pixels[a, 0], pixels[a, 1]
        bx, by = pixels[b, 0], pixels[b, 1]
        cx, cy = pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0 or not np.isfinite(area):
            continue
        column_first = max(0, int(np.ceil(min(ax, bx, cx))))
        column_last = min(width - 1, int(np.floor(max(ax, bx, cx))))
        row_first = max(0, int(np.ceil(min(ay, by, cy))))
        row_last = min(height - 1, int(np.floor(max(ay, by, cy))))
        za, zb, zc = depth[a], depth[b], depth[c]
        for row in range(row_first, row_last + 1):
            for column in range(column_first, column_last + 1):
                wa = ((bx - column) * (cy - row) - (by - row) * (cx - column)) / area
                wb = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) / area
                wc = 1.0 - wa - wb
                # A hair of tolerance keeps texels on a shared edge from falling between two faces.
                if min(wa, wb, wc) < -1e-9:
                    continue
                z = wa * za + wb * zb + wc * zc
                if z > nearest[row, column]:
                    nearest[row, column] = z
                    if owned:
                        owner[row, column] = f
                        weights[row, column, 0] = wa
                        weights[row, column, 1] = wb
                        weights[row, column, 2] = wc


def interpolate(raster: Raster, faces: IntArray, values: RealArray) -> FloatArray:
    """Return per-vertex `values` (V, ...) interpolated over the raster (H, W, ...), zeros outside."""
    result = np.zeros(raster.face.shape + values.shape[1:])
    inside = raster.covered
    corners = values[faces[raster.face[inside]]]
    result[inside] = np.einsum("nk,nk...->n...", raster.barycentric[inside], corners)
    return result


def bilinear(image: RealArray, pixels: FloatArray) -> FloatArray:
    """Return (N, C) of an image (H, W, C) at pixels (N, 2), column and row; its edges continue outside."""
    (rows, columns), (column, row) = image.shape[:2], pixels.T
    column, row = np.clip(column, 0, columns - 1), np.clip(row, 0, rows - 1)
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    right, below = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    across, down = (column - left)[:, None], (row - top)[:, None]
    # `take` of whole rows costs a third of what two indices do.
    texels = image.reshape(rows * columns, -1)
    upper = (1 - across) * texels.take(top * columns + left, 0)
    upper += across * texels.take(top * columns + right, 0)
    lower = (1 - across) * texels.take(below * columns + left, 0)
    lower += across * texels.take(below * columns + right, 0)
    return (1 - down) * upper + down * lower


def within(pixels: NDArray, shape: tuple[int, ...], margin: float = 0) -> BoolArray:
    """Return (N,) whether pixels (N, 2), column and row, lie in (H, W, ...) or `margin` beside it."""
    last = np.array(shape[1::-1]) - 1
    with np.errstate(invalid="ignore"):  # NaN does not
        return np.asarray(((pixels >= -margin) & (pixels <= last + margin)).all(1))


def polyline_distance(points: FloatArray, line: FloatArray) -> FloatArray:
    """Return the distances (N,) of points (N, 2) from a polyline (K, 2).

    >>> polyline_distance(np.array([[1.0, 2.0], [5.0, 0.0]]), np.array([[0.0, 0.0], [2.0, 0.0]]))
    array([2., 3.])
    """
    nearest = np.full(len(points), np.inf)
    for start, end in pairwise(line):
        offset, along = points - start, end - start
        part = np.clip(offset @ along / max(float(along @ along), 1e-12), 0, 1)
        nearest = np.minimum(nearest, norms(offset - part[:, None] * along))
    return nearest


def bilinear_slopes(image: RealArray, pixels: FloatArray) -> FloatArray:
    """Return the derivatives (N, C, 2) of `bilinear` by column and row, beyond an edge those at it."""
    last = np.array(image.shape[1::-1]) - 1
    place = np.clip(pixels, 0, last)
    corner = np.minimum(place, last - 1).astype(int)
    (x, y), (column, row) = (place - corner).T[..., None], corner.T
    a, b = image[row, column], image[row, column + 1]
    c, d = image[row + 1, column], image[row + 1, column + 1]
    return np.stack([(1 - y) * (b - a) + y * (d - c), (1 - x) * (c - a) + x * (d - b)], 2)


def filled_from_nearest(image: NDArray, mask: BoolArray) -> FloatArray:
    """Return an image (H, W, ...) whose pixels outside of `mask` have the value of the nearest one inside.

    Interpolation and averages at the mask's border then mix in no empty pixel.
    """
    if mask.all():
        return image.astype(float)
    from scipy.ndimage import distance_transform_edt

    row, column = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return image[row, column].astype(float)


def area_mean(values: ArrayLike, shape: GridShape) -> FloatArray:
    """Return an image (H, W) or (H, W, C) with `shape` pixels, at most as many as it has on either side.

    Pixels that an area covers in part count by that part, as `cv2.INTER_AREA` and scikit-image's
    `resize_local_mean` do it, but in O(H W): sums are differences of sums from the edge on.

    >>> area_mean(np.arange(6.0).reshape(2, 3), (1, 2)).tolist()
    [[1.8333333333333333, 3.1666666666666665]]
    """
    result = np.asarray(values, float)
    size = result.shape[:2]
    for axis, count in enumerate(shape):
        lines = np.moveaxis(result, axis, 0)
        step, rest = divmod(size[axis], count)
        if rest == 0:  # whole pixels alone: their sums take a third of the time
            result = np.moveaxis(np.add.reduce([lines[first::step] for first in range(step)]), 0, axis)
            continue
        sums = np.concatenate([np.zeros_like(lines[:1]), np.cumsum(lines, axis=0)])
        edges = np.arange(count + 1) * size[axis] / count
        whole = np.minimum(edges.astype(int), size[axis] - 1)
        part = (edges - whole).reshape(-1, *[1] * (lines.ndim - 1))
        result = np.moveaxis(np.diff(sums[whole] + part * lines[whole], axis=0), 0, axis)
    return result / (size[0] * size[1] / (shape[0] * shape[1]))


def area_interpolated(values: FloatArray, shape: GridShape) -> FloatArray:
    """Return an image (H, W, ...) of more pixels, `shape`: what `area_mean` made smaller, if it is smooth."""
    result = values
    for axis, count in enumerate(shape):
        lines = np.moveaxis(result, axis, 0)
        place = np.clip((np.arange(count) + 0.5) * len(lines) / count - 0.5, 0, len(lines) - 1)
        before = np.minimum(place.astype(int), len(lines) - 2)
        part = (place - before).reshape(-1, *[1] * (lines.ndim - 1))
        result = np.moveaxis((1 - part) * lines[before] + part * lines[before + 1], 0, axis)
    return result


def filled_smoothly(values: NDArray, known: BoolArray) -> NDArray:
    """Return an image (H, W, C) as `fill_smoothly` leaves it; `values` stay."""
    filled = values.copy()
    fill_smoothly(filled, known)
    return filled


def fill_smoothly(values: NDArray, known: BoolArray) -> None:
    """Set the pixels of an image (H, W, C) outside of `known` (H, W) to means of what lies around them.

    Each is taken, by bilinear interpolation, from the finest of images of half the size that knows something
    there (pull-push [1]_). O(H W), in bands of rows. Nothing is changed where nothing is known.

    .. [1] S. Gortler, R. Grzeszczuk, R. Szeliski, M. Cohen, "The Lumigraph", SIGGRAPH 1996, section 4.
    """
    if known.all() or not known.any():
        return
    height, width = known.shape
    half = np.array([-(-height // 2), -(-width // 2)])
    coarse, there = np.empty((*half, values.shape[2]), values.dtype), np.empty(half, bool)
    # A pixel of a half of odd height has parts of three rows, so that no rows begin a band.
    rows = max(2**18 // width, 1) * 2 if height % 2 == 0 else height
    for top in range(0, height, rows):
        band, small = np.s_[top : top + rows], np.s_[top // 2 : -(-min(top + rows, height) // 2)]
        shape = coarse[small].shape[:2]
        part = area_mean(known[band], shape)
        # Sums of what is known differ from 0 by rounding only where nothing is known.
        there[small] = part > 1e-6
        total = area_mean(values[band] * known[band, :, None], shape)
        coarse[small] = total / np.where(there[small], part, 1.0)[..., None]
    fill_smoothly(coarse, there)
    for top in range(0, height, rows):
        row, column = np.nonzero(~known[top : top + rows])
        row += top
        middle = np.stack([column, row], axis=1) + 0.5
        values[row, column] = bilinear(coarse, middle * (half / known.shape)[::-1] - 0.5)


_HAIR = 1e-6
"""By so much a coordinate may be off a whole number."""


@dataclass(frozen=True)
class FrontPicture:
    """`color` (H, W, 3), linear, `depth` (H, W), z in mm, which squares have `seen` colour; row 0 is lowest.

    The centre of square (row, column) lies at `low` (2,) + `step_mm` (column, row).
    """

    color: FloatArray
    depth: FloatArray
    seen: BoolArray
    low: FloatArray
    step_mm: float


def front_picture(
    scan: RawScan, frame_from_scan: FloatArray, low: FloatArray, high: FloatArray, step_mm: float
) -> FrontPicture:
    """Return the picture of a scan with colour, moved by a (4, 4) transform, between two corners (2,).

    Triangles that look away are left out, and those of more than 30 mm, which torn scans have across holes.
    """
    columns, rows = (np.ceil((high - low) / step_mm).astype(int) + 1).tolist()
    # Texels are finer than squares: each square is the mean of two looks along both axes.
    fine = step_mm / 2
    vertices = transform_points(frame_from_scan, scan.vertices)
    corners = vertices[scan.faces]
    least, most = corners[..., :2].min(1), corners[..., :2].max(1)
    inside = ((most > low) & (least < high) & (most - least < 30)).all(1)
    first_side, second_side = triangle_sides(corners)
    used = np.flatnonzero(
        inside & (first_side[:, 0] * second_side[:, 1] > first_side[:, 1] * second_side[:, 0])
    )
    # The first look at a square lies half a square beside its centre, and half a look inward.
    first = low - (step_mm - fine) / 2
    shape = rows * 2, columns * 2
    raster = rasterize((vertices[:, :2] - first) / fine, vertices[:, 2], scan.faces[used], shape)
    covered = raster.covered
    face, barycentric = used[raster.face[covered]], raster.barycentric[covered]
    looked, shown = np.zeros((*shape, 4)), covered.copy()
    colors, shown[covered] = scan_colors(scan, face, barycentric)
    looked[covered, :3] = colors * shown[covered, None]
    looked[covered, 3] = dots(barycentric, vertices[scan.faces[face], 2])
    blocks = rows, 2, columns, 2
    count, seen = (looks.reshape(blocks).sum((1, 3)) for looks in (covered, shown))
    total = looked.reshape(*blocks, 4).sum((1, 3))
    color, depth = total[..., :3] / np.maximum(seen, 1)[..., None], total[..., 3] / np.maximum(count, 1)
    return FrontPicture(color, depth, seen > 0, low, step_mm)


def scan_colors(scan: RawScan, face: IntArray, barycentric: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return a coloured scan's colours (N, 3) at points of its faces (N,), and where a picture showed it."""
    if scan.uv is None or scan.texture_linear is None:
        assert scan.vertex_color_linear is not None
        corners = scan.faces[face]
        colors = np.einsum("nk,nkc->nc", barycentric, scan.vertex_color_linear[corners])
        shown = None if scan.color_seen is None else scan.color_seen[corners].all(1)
    else:
        places = scan.uv[face]
        places = places - np.floor(places.min(axis=1, keepdims=True) + _HAIR)  # by whole periods
        uv = np.einsum("nk,nkc->nc", barycentric, places) % (1 + 2 * _HAIR)
        pixels = pixels_from_uv(uv, scan.texture_linear.shape[:2])
        colors, shown = bilinear(scan.texture_linear, pixels), None
        if scan.color_seen is not None:
            shown = bilinear(scan.color_seen[..., None].astype(np.float32), pixels)[:, 0] > 1 - _HAIR
    return np.maximum(colors, 0.0), np.ones(len(face), bool) if shown is None else np.asarray(shown)
