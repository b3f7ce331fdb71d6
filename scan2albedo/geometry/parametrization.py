"""One flip-free chart of a disc-like surface in the unit square: Tutte, SLIM, xatlas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ModelError
from scan2albedo.geometry.mesh import adjacency, edges_with_faces, face_areas, vertex_components

SQUARENESS = 2.5
"""Exponent p of the boundary curve ``|x|^p + |y|^p = 1``: 2 is a circle (78 % of the square), 2.5 fills 85 %,
3 fills 88 %. The corners take up some angular distortion."""
PADDING_TEXELS, RESOLUTION_TEXELS = 2, 512
"""Margin that xatlas leaves around the chart, at this resolution."""


@dataclass(frozen=True)
class ChartOptions:
    """How `parametrize_disc` draws a chart."""

    boundary_weight: float = 100.0
    """Soft penalty that keeps the boundary on the curve during SLIM, relative to the surface's area."""
    slim_iterations: int = 30
    """Newton-like iterations of SLIM; 0 leaves Tutte's map."""


def parametrize_disc(
    vertices: FloatArray,
    faces: IntArray,
    *,
    mirror: IntArray | None = None,
    options: ChartOptions | None = None,
) -> FloatArray:
    """Return the (V, 2) flip-free chart of a surface with disc topology, in the unit square.

    The faces (F, 3) are one component with one boundary loop and no handle, counter-clockwise from outside;
    the chart is turned so that u grows with +x and v with +y. With the mirror image of each vertex (itself on
    the midline) in `mirror` (V,) the chart is exactly symmetric about u = 0.5. It starts from uniform
    weights, flip-free on a convex boundary [1]_, and is improved by SLIM [2]_. Raises ModelError when the
    surface is no disc, or the chart has flipped faces (faces without area).

    .. [1] W. T. Tutte, "How to draw a graph", 1963.
    .. [2] M. Rabinovich et al., "Scalable Locally Injective Mappings", ACM TOG 36(2), 2017.
    """
    chosen = ChartOptions() if options is None else options
    index = np.asarray(faces, np.int64)
    uv = flatten_disc(vertices, index, mirror=mirror, options=chosen)
    uv = _packed(uv, index)
    flipped = int(np.sum(signed_areas(uv, index) <= 0))
    if flipped:
        raise ModelError(
            f"the chart has {flipped} of {len(index)} faces flipped or without area; "
            "remove zero-area faces and ears from the mesh, or give UVs of your own"
        )
    return uv


def flatten_disc(
    vertices: FloatArray,
    faces: IntArray,
    *,
    mirror: IntArray | None = None,
    options: ChartOptions | None = None,
) -> FloatArray:
    """Return the (V, 2) chart of `parametrize_disc` before packing: about unit area, centred.

    A small `boundary_weight` lets SLIM choose the boundary: the chart is then as isometric as it gets.
    """
    chosen = ChartOptions() if options is None else options
    xyz, index = np.asarray(vertices, float), np.asarray(faces, np.int64)
    loop = boundary_loop(len(xyz), index)
    # SLIM's energy is not scale invariant: unit area on both sides.
    xyz = (xyz - xyz.mean(0)) / np.sqrt(face_areas(xyz, index).sum())
    target = boundary_curve(xyz, loop)
    uv = tutte(len(xyz), index, loop, target)
    if chosen.slim_iterations:
        uv = _slim(xyz, index, uv, loop, target, chosen)
    return _symmetrized(uv, mirror)


def boundary_loop(vertex_count: int, faces: IntArray) -> IntArray:
    """Return the (B,) vertices of the one boundary loop, counter-clockwise with the faces.

    Raises ModelError when the faces do not form one manifold disc.

    >>> boundary_loop(4, np.array([[0, 1, 2], [0, 2, 3]]))
    array([0, 1, 2, 3])
    """
    edges, uses = edges_with_faces(faces)
    used = np.unique(faces)
    components = len(np.unique(vertex_components(vertex_count, faces)[used]))
    following = _boundary_successors(faces)
    euler = len(used) - len(edges) + len(faces)
    loop = _walk(following)
    if components != 1 or uses.max() > 2 or euler != 1 or len(loop) != len(following):
        raise ModelError(
            f"the mesh is no disc: {components} components, {int((uses > 2).sum())} edges with more than two "
            f"faces, Euler characteristic {euler}, {len(following)} boundary edges of which one loop has "
            f"{len(loop)}; expected one component, characteristic 1 and one loop. Fill its holes, or cut it"
        )
    if len(used) != vertex_count:
        raise ModelError(f"{vertex_count - len(used)} of {vertex_count} vertices are in no face; remove them")
    return loop


def _boundary_successors(faces: IntArray) -> dict[int, int]:
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, first, counts = np.unique(np.sort(directed, axis=1), axis=0, return_index=True, return_counts=True)
    return {int(a): int(b) for a, b in directed[first[counts == 1]]}


def _walk(following: dict[int, int]) -> IntArray:
    if not following:
        return np.empty(0, np.int64)
    start = min(following)
    loop, at = [start], following[start]
    while at != start and at in following and len(loop) < len(following):
        loop.append(at)
        at = following[at]
    return np.array(loop, np.int64)


def boundary_curve(vertices: FloatArray, loop: IntArray) -> FloatArray:
    """Return (B, 2) places of the boundary loop on ``|x|^p + |y|^p = r^p`` of unit area.

    Arc length is kept up to scale; the start is turned so that the loop's directions seen from the front
    (xy-plane, from the boundary's centroid) agree best with those on the curve.
    """
    points = vertices[loop]
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    arc = np.concatenate([[0.0], np.cumsum(steps)[:-1]]) / steps.sum()
    weight = steps + np.roll(steps, 1)
    centered = points[:, :2] - np.average(points[:, :2], axis=0, weights=weight)
    direction = np.exp(1j * np.arctan2(centered[:, 1], centered[:, 0]))
    angle, table = _superellipse(SQUARENESS)
    phase = np.angle(np.sum(weight * direction * np.exp(-2j * np.pi * arc))) / (2 * np.pi)
    at = (arc + phase) % 1.0
    return np.stack([np.interp(at, angle, table[:, 0]), np.interp(at, angle, table[:, 1])], 1)


def _superellipse(squareness: float) -> tuple[FloatArray, FloatArray]:
    """Return (normalised arc length (N,), points (N, 2)) of the unit-area curve from +x on."""
    t = np.linspace(0, 2 * np.pi, 4097)
    x, y = np.cos(t), np.sin(t)
    radius = (np.abs(x) ** squareness + np.abs(y) ** squareness) ** (-1 / squareness)
    points = np.stack([x * radius, y * radius], 1)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    area = 0.5 * np.sum(points[:-1, 0] * points[1:, 1] - points[1:, 0] * points[:-1, 1])
    return np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum(), points / np.sqrt(area)


def tutte(vertex_count: int, faces: IntArray, loop: IntArray, target: FloatArray) -> FloatArray:
    """Return the (V, 2) map with every inner vertex at the mean of its neighbours, `loop` at `target`."""
    ring = adjacency(vertex_count, faces)
    laplacian = (sparse.diags(np.asarray(ring.sum(1)).ravel()) - ring).tocsr()
    inner = np.setdiff1d(np.arange(vertex_count), loop)
    uv = np.zeros((vertex_count, 2))
    uv[loop] = target
    if len(inner):
        uv[inner] = splu(laplacian[inner][:, inner].tocsc()).solve(-laplacian[inner][:, loop] @ target)
    return uv


def _slim(
    vertices: FloatArray,
    faces: IntArray,
    start: FloatArray,
    loop: IntArray,
    target: FloatArray,
    options: ChartOptions,
) -> FloatArray:
    import igl

    data = igl.slim_precompute(
        np.asfortranarray(vertices),
        np.asfortranarray(faces, dtype=np.int32),
        np.asfortranarray(start),
        igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
        loop.astype(np.int32),
        np.asfortranarray(target),
        options.boundary_weight,
    )
    return np.ascontiguousarray(igl.slim_solve(data, options.slim_iterations)[:, :2])


def _symmetrized(uv: FloatArray, mirror: IntArray | None) -> FloatArray:
    if mirror is None:
        return uv
    middle = 0.5 * (uv[:, 0].min() + uv[:, 0].max())
    offset = uv - [middle, 0.0]
    return 0.5 * (offset + offset[mirror] * [-1.0, 1.0])


def _packed(uv: FloatArray, faces: IntArray) -> FloatArray:
    """Fill the unit square with the chart, xatlas's margin around it, its centre at 0.5."""
    import xatlas

    low, high = uv.min(0), uv.max(0)
    unit = (uv - low) / (high - low)
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(unit.astype(np.float32), faces.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.padding, pack.resolution = PADDING_TEXELS, RESOLUTION_TEXELS
    pack.rotate_charts = pack.rotate_charts_to_axis = False
    atlas.generate(pack_options=pack)
    origin, _, packed = atlas.get_mesh(0)
    if atlas.chart_count != 1:
        raise ModelError(f"xatlas packed {atlas.chart_count} charts, expected one")
    packed_span = packed.max(0) - packed.min(0)
    if len(np.unique(origin)) != len(uv) or packed_span.min() <= 0:
        raise ModelError("xatlas lost vertices of the chart while packing it")
    # float32 and texel snapping are xatlas's; its scale is kept, the double precision coordinates too.
    return 0.5 + (unit - 0.5) * np.minimum(packed_span, 1.0)


def signed_areas(uv: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F,) signed areas of 2D triangles, positive when counter-clockwise."""
    a, b, c = uv[faces[:, 0]], uv[faces[:, 1]], uv[faces[:, 2]]
    return 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]))
