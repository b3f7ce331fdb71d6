"""The picture of a coloured scan as seen along -z: one colour for each square of the x-y plane."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.rasterization import bilinear, rasterize
from scan2albedo.geometry.rigid import transform_points

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
    across, beside = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    used = np.flatnonzero(inside & (across[:, 0] * beside[:, 1] > across[:, 1] * beside[:, 0]))
    # The first look at a square lies half a square beside its centre, and half a look inward.
    first = low - (step_mm - fine) / 2
    shape = rows * 2, columns * 2
    raster = rasterize((vertices[:, :2] - first) / fine, vertices[:, 2], scan.faces[used], shape)
    covered = raster.covered
    face, barycentric = used[raster.face[covered]], raster.barycentric[covered]
    looked, shown = np.zeros((*shape, 4)), covered.copy()
    colors, shown[covered] = scan_colors(scan, face, barycentric)
    looked[covered, :3] = colors * shown[covered, None]
    looked[covered, 3] = np.einsum("nk,nk->n", barycentric, vertices[scan.faces[face], 2])
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
        u, v = np.einsum("nk,nkc->nc", barycentric, places).T % (1 + 2 * _HAIR)
        height, width = scan.texture_linear.shape[:2]
        pixels = np.stack([u * width - 0.5, (1 - v) * height - 0.5], axis=1)
        colors, shown = bilinear(scan.texture_linear, pixels), None
        if scan.color_seen is not None:
            shown = bilinear(scan.color_seen[..., None].astype(np.float32), pixels)[:, 0] > 1 - _HAIR
    return np.maximum(colors, 0.0), np.ones(len(face), bool) if shown is None else np.asarray(shown)
