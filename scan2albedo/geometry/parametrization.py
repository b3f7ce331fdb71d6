"""One flip-free chart of a disc-like surface in the unit square: Tutte, SLIM."""

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray, norms
from scan2albedo.errors import ModelError
from scan2albedo.geometry import mesh
from scan2albedo.geometry.fields import filled_over_mesh

SQUARENESS = 2.5
"""Exponent p of the boundary curve ``|x|^p + |y|^p = 1``: 2 is a circle (78 % of the square), 2.5 fills 85 %,
3 fills 88 %. The corners take up some angular distortion."""


def parametrize_disc(vertices: FloatArray, faces: IntArray, *, mirror: IntArray | None = None) -> FloatArray:
    """Return the (V, 2) flip-free chart of a surface with disc topology, in the unit square.

    u grows with +x and v with +y. With the mirror image of each vertex in `mirror` (V,) the chart is
    symmetric about u = 0.5. It starts from uniform weights [1]_ and is improved by SLIM [2]_. Raises
    ModelError when the surface is not a disc, or the chart has flipped faces (faces without area).

    .. [1] W. T. Tutte, "How to draw a graph", 1963.
    .. [2] M. Rabinovich et al., "Scalable Locally Injective Mappings", ACM TOG 36(2), 2017.
    """
    index = np.asarray(faces, int)
    uv = flatten_disc(vertices, index, mirror)
    # Fill the unit square but for the margin that xatlas leaves around a chart of 512 texels.
    low, high = uv.min(0), uv.max(0)
    uv = 0.5 + ((uv - low) / (high - low) - 0.5) * (516 / 517)
    flipped = int(np.sum(signed_areas(uv, index) <= 0))
    if flipped:
        said = f"the chart has {flipped} of {len(index)} faces flipped or without area"
        raise ModelError(f"{said}; remove zero-area faces and ears from the mesh, or give UVs of your own")
    return uv


def flatten_disc(vertices: FloatArray, faces: IntArray, mirror: IntArray | None) -> FloatArray:
    """Return the (V, 2) chart of `parametrize_disc` before packing: about unit area, centred."""
    import igl

    xyz, index = np.asarray(vertices, float), np.asarray(faces, int)
    loop = boundary_loop(len(xyz), index)
    # SLIM's energy is not scale invariant: unit area on both sides.
    xyz = (xyz - xyz.mean(0)) / np.sqrt(mesh.face_areas(xyz, index).sum())
    target = boundary_curve(xyz, loop)
    data = igl.slim_precompute(
        np.asfortranarray(xyz),
        np.asfortranarray(index, dtype=np.int32),
        np.asfortranarray(tutte(len(xyz), index, loop, target)),
        igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
        loop.astype(np.int32),
        np.asfortranarray(target),
        100.0,  # a small weight would let SLIM choose the boundary
    )
    uv = np.ascontiguousarray(igl.slim_solve(data, 30)[:, :2])
    if mirror is None:
        return uv
    offset = uv - [(uv[:, 0].min() + uv[:, 0].max()) / 2, 0.0]
    return (offset + offset[mirror] * [-1.0, 1.0]) / 2


def boundary_loop(vertex_count: int, faces: IntArray) -> IntArray:
    """Return the (B,) vertices of the one boundary loop, counter-clockwise with the faces.

    Raises ModelError when the faces do not form one manifold disc.

    >>> boundary_loop(4, np.array([[0, 1, 2], [0, 2, 3]]))
    array([0, 1, 2, 3])
    """
    edges, uses = mesh.edges_with_faces(faces)
    used, loops = np.unique(faces), mesh.boundary_loops(faces)
    components = len(np.unique(mesh.vertex_components(vertex_count, faces)[used]))
    euler = len(used) - len(edges) + len(faces)
    if components != 1 or uses.max() > 2 or euler != 1 or len(loops) != 1:
        raise ModelError(
            f"the mesh is not a disc: {components} components, {(uses > 2).sum()} edges with more than "
            f"two faces, Euler characteristic {euler}, {len(loops)} boundary loops; expected one component, "
            "characteristic 1 and one loop. Fill its holes, or cut it"
        )
    if len(used) != vertex_count:
        raise ModelError(f"{vertex_count - len(used)} of {vertex_count} vertices are in no face; remove them")
    return np.roll(loops[0], -int(np.argmin(loops[0])))


def boundary_curve(vertices: FloatArray, loop: IntArray) -> FloatArray:
    """Return (B, 2) places of the boundary loop on ``|x|^p + |y|^p = r^p`` of unit area.

    Arc length is kept up to scale; the start is turned to agree with the loop's directions from the front.
    """
    points = vertices[loop]
    steps = norms(np.roll(points, -1, axis=0) - points)
    arc = np.concatenate([[0.0], np.cumsum(steps)[:-1]]) / steps.sum()
    weight = steps + np.roll(steps, 1)
    centered = points[:, :2] - np.average(points[:, :2], axis=0, weights=weight)
    direction = np.exp(1j * np.arctan2(centered[:, 1], centered[:, 0]))
    phase = np.angle(np.sum(weight * direction * np.exp(-2j * np.pi * arc))) / (2 * np.pi)
    # Normalised arc lengths and points of the unit-area curve from +x on.
    t = np.linspace(0, 2 * np.pi, 4097)
    unit = np.stack([np.cos(t), np.sin(t)], 1)
    curve = unit * (np.abs(unit) ** SQUARENESS).sum(1, keepdims=True) ** (-1 / SQUARENESS)
    along = norms(np.diff(curve, axis=0))
    area = np.sum(curve[:-1, 0] * curve[1:, 1] - curve[1:, 0] * curve[:-1, 1]) / 2
    at, length = (arc + phase) % 1.0, np.concatenate([[0.0], np.cumsum(along)]) / along.sum()
    return np.stack([np.interp(at, length, side) for side in (curve / np.sqrt(area)).T], 1)


def tutte(vertex_count: int, faces: IntArray, loop: IntArray, target: FloatArray) -> FloatArray:
    """Return the (V, 2) map with every inner vertex at the mean of its neighbours, `loop` at `target`."""
    uv = np.zeros((vertex_count, 2))
    uv[loop] = target
    return filled_over_mesh(uv, mesh.vertex_mask(vertex_count, loop), faces)


def signed_areas(uv: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F,) signed areas of 2D triangles, positive when counter-clockwise."""
    a, b, c = uv[faces[:, 0]], uv[faces[:, 1]], uv[faces[:, 2]]
    return ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])) / 2
