"""Turn anyone's face template into a closed-holed, consistently oriented disc in millimetres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ModelError
from scan2albedo.geometry.hole_filling import boundary_loops, fill_hole
from scan2albedo.geometry.mesh import (
    edges_with_faces,
    face_areas,
    face_cross_products,
    vertex_components,
    without_unreferenced,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_VERTICES = 100
MAX_FILLED_LOOP = 600
HEAD_SIZE_MM = (80.0, 600.0)
UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
BACK_OF_HEAD = 0.35


@dataclass(frozen=True)
class CleanTemplate:
    """A template ready for decimation.

    Parameters
    ----------
    vertices : (K, 3) float64
        Millimetres, origin at the centroid of `all_vertices`.
    faces : (F, 3) int64
        One disc, holes filled, counter-clockwise from outside.
    filled : (F,) bool
        True for faces that close a hole the template had.
    source : (K,) int64
        Template vertex each of `vertices` was.
    all_vertices : (T, 3) float64
        Every template vertex in the same frame and unit, the template's order.
    unit : str
        The unit decided for the input.
    """

    vertices: FloatArray
    faces: IntArray
    filled: NDArray[np.bool_]
    source: IntArray
    all_vertices: FloatArray
    unit: str


def clean_template(vertices: FloatArray, faces: IntArray, name: str) -> CleanTemplate:
    """Check and mend a template: unit, duplicates, components, orientation, holes, disc topology.

    Parameters
    ----------
    vertices : (T, 3) array of float
        Millimetres, centimetres or metres; +x left, +y up, +z out of the face.
    faces : (F, 3) array of int
    name : str
        Used in messages.

    Raises
    ------
    ModelError
        Wrong shapes, NaN, too few vertices, no faces, bad indices, no head's size, edges with three
        faces, a surface that cannot be oriented, or handles.
    """
    xyz, index = _checked(vertices, faces, name)
    unit = _unit(xyz[np.unique(index)], name)
    xyz = xyz * UNITS_MM[unit]
    xyz = xyz - xyz[np.unique(index)].mean(0)
    welded = _welded(xyz, index)
    mesh = _manifold(_largest_component(len(xyz), welded), name)
    mesh = _outward(xyz, _front_of_closed(xyz, mesh))
    closed, filled = _holes_filled(xyz, mesh)
    _require_disc(closed, name)
    source, renumbered = without_unreferenced(xyz, closed)
    return CleanTemplate(xyz[source], renumbered, filled, source, xyz, unit)


def _checked(vertices: FloatArray, faces: IntArray, name: str) -> tuple[FloatArray, IntArray]:
    xyz, index = np.array(vertices, np.float64), np.array(faces)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ModelError(f"{name}: template vertices have shape {xyz.shape}, expected (T, 3)")
    if index.ndim != 2 or index.shape[1] != 3 or len(index) == 0:
        raise ModelError(
            f"{name}: template faces have shape {index.shape}, expected (F, 3) with F > 0; "
            "triangulate the mesh, a point cloud is not enough"
        )
    if not np.isfinite(xyz).all():
        bad = int((~np.isfinite(xyz)).any(1).sum())
        raise ModelError(f"{name}: {bad} template vertices are NaN or infinite; repair or re-export it")
    index = index.astype(np.int64)
    if index.min() < 0 or index.max() >= len(xyz):
        wrong = index.min() if index.min() < 0 else index.max()
        raise ModelError(f"{name}: a face refers to vertex {wrong}, but there are {len(xyz)} vertices")
    used = len(np.unique(index))
    if used < MIN_VERTICES:
        raise ModelError(f"{name}: the template has {used} vertices in faces, at least {MIN_VERTICES} needed")
    return xyz, index


def _unit(xyz: FloatArray, name: str) -> str:
    size = float(np.max(np.ptp(xyz, axis=0)))
    for unit, factor in UNITS_MM.items():
        if HEAD_SIZE_MM[0] <= size * factor <= HEAD_SIZE_MM[1]:
            return unit
    low, high = HEAD_SIZE_MM
    raise ModelError(
        f"{name}: the template is {size:.4g} units large, which is no head in mm, cm or m "
        f"({low:.0f} to {high:.0f} mm); scale it to millimetres"
    )


def _welded(xyz: FloatArray, faces: IntArray) -> IntArray:
    """Join vertices at equal positions (UV seams), unless that makes an edge with three faces."""
    step = 1e-7 * float(np.max(np.ptp(xyz, axis=0)))
    _, first, inverse = np.unique(np.round(xyz / step), axis=0, return_index=True, return_inverse=True)
    joined = first[inverse.ravel()][faces]
    return _proper(xyz, joined if _edge_manifold(_proper(xyz, joined)) else faces)


def _proper(xyz: FloatArray, faces: IntArray) -> IntArray:
    """Drop faces with a repeated corner, no area, or the same corners as an earlier face."""
    area = face_areas(xyz, faces)
    good = faces[area > 1e-14 * area.max()]
    _, first = np.unique(np.sort(good, axis=1), axis=0, return_index=True)
    return good[np.sort(first)]


def _edge_manifold(faces: IntArray) -> bool:
    return len(faces) > 0 and int(edges_with_faces(faces)[1].max()) <= 2


def _largest_component(vertex_count: int, faces: IntArray) -> IntArray:
    label = vertex_components(vertex_count, faces)[faces[:, 0]]
    return faces[label == np.bincount(label).argmax()]


def _manifold(faces: IntArray, name: str) -> IntArray:
    import igl

    edges, uses = edges_with_faces(faces)
    if uses.max() > 2:
        edge = edges[uses > 2][0].tolist()
        raise ModelError(
            f"{name}: {int((uses > 2).sum())} edges have more than two faces, first between vertices {edge}; "
            "remove inner faces"
        )
    oriented = np.asarray(igl.bfs_orient(faces)[0], np.int64)
    directed = oriented[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    if len(np.unique(directed, axis=0)) < len(directed):
        raise ModelError(f"{name}: the surface cannot be oriented (it is one-sided); use an orientable mesh")
    pinched = np.setdiff1d(np.flatnonzero(~igl.is_vertex_manifold(oriented)), _unused(oriented))
    if len(pinched):
        raise ModelError(
            f"{name}: {len(pinched)} vertices join surfaces at a single point, first {int(pinched[0])}; "
            "split them"
        )
    return oriented


def _unused(faces: IntArray) -> IntArray:
    return np.setdiff1d(np.arange(faces.max() + 1), faces)


def _front_of_closed(xyz: FloatArray, faces: IntArray) -> IntArray:
    """Cut the back off a closed head, so that a rim exists; open meshes stay whole."""
    if len(boundary_loops(faces)):
        return faces
    depth = xyz[:, 2]
    low, high = depth[faces].min(), depth[faces].max()
    front = faces[(depth[faces] > low + BACK_OF_HEAD * (high - low)).all(1)]
    return _largest_component(len(xyz), front)


def _outward(xyz: FloatArray, faces: IntArray) -> IntArray:
    corner = xyz[faces[:, 0]] - xyz[np.unique(faces)].mean(0)
    volume = float(np.sum(face_cross_products(xyz, faces) * corner))
    return faces if volume >= 0 else faces[:, ::-1].copy()


def _holes_filled(xyz: FloatArray, faces: IntArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """Close every boundary loop but the one with the greatest length in mm."""
    loops = [loop for loop in boundary_loops(faces) if len(loop) >= 3]
    length = [float(np.linalg.norm(xyz[loop] - xyz[np.roll(loop, 1)], axis=1).sum()) for loop in loops]
    rim = int(np.argmax(length)) if loops else -1
    patches = [
        fill_hole(xyz, faces, loop)
        for i, loop in enumerate(loops)
        if i != rim and len(loop) <= MAX_FILLED_LOOP
    ]
    extra = np.concatenate(patches) if patches else np.zeros((0, 3), np.int64)
    return np.concatenate([faces, extra]), np.arange(len(faces) + len(extra)) >= len(faces)


def _require_disc(faces: IntArray, name: str) -> None:
    edges, _ = edges_with_faces(faces)
    euler = len(np.unique(faces)) - len(edges) + len(faces)
    loops = len(boundary_loops(faces))
    if euler == 1 and loops == 1:
        return
    raise ModelError(
        f"{name}: after filling holes the surface has {loops} rims and Euler characteristic {euler}, "
        "expected 1 and 1 (a disc); close handles or cut the face out of the head"
    )
