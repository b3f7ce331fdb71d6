"""Turn the surface of anyone's face template into a disc: a closed head cut open, holes filled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import ModelError
from scan2albedo.geometry.mesh import boundary_loops, edges_with_faces, without_unreferenced
from scan2albedo.templates.surface import TemplateSurface, largest_component

_BACK_OF_HEAD = 0.35


@dataclass(frozen=True)
class CleanTemplate:
    """A template ready for decimation: one disc, holes filled, counter-clockwise from outside.

    `vertices` (K, 3) in mm, origin at the centroid of `all_vertices` (T, 3), the template's own in the same
    frame; `source` (K,) is the template vertex of each. `filled` (F,) marks faces that close `holes`.
    """

    vertices: FloatArray
    faces: IntArray
    filled: BoolArray
    source: IntArray
    all_vertices: FloatArray
    holes: int


def clean_template(surface: TemplateSurface, name: str) -> CleanTemplate:
    """Cut a closed head in the model's axes open at the back, fill the holes, and check that it is a disc.

    Raises `ModelError` when the surface has handles or holes too long to fill.
    """
    xyz, mesh = surface.vertices, surface.faces
    if not len(boundary_loops(mesh)):
        depth = xyz[:, 2]
        low, high = depth[mesh].min(), depth[mesh].max()
        mesh = largest_component(len(xyz), mesh[(depth[mesh] > low + _BACK_OF_HEAD * (high - low)).all(1)])
    # Every boundary loop is closed but the one with the greatest length in mm.
    loops = [loop for loop in boundary_loops(mesh) if len(loop) >= 3]
    length = [float(np.linalg.norm(xyz[loop] - xyz[np.roll(loop, 1)], axis=1).sum()) for loop in loops]
    rim = int(np.argmax(length)) if loops else -1
    holes = [loop for i, loop in enumerate(loops) if i != rim and len(loop) <= 600]
    closed = np.concatenate([mesh, *(fill_hole(xyz, mesh, loop) for loop in holes)])
    filled = np.arange(len(closed)) >= len(mesh)
    edges, _ = edges_with_faces(closed)
    euler = len(np.unique(closed)) - len(edges) + len(closed)
    rims = len(boundary_loops(closed))
    if euler != 1 or rims != 1:
        raise ModelError(
            f"{name}: after filling holes the surface has {rims} rims and Euler characteristic {euler}, "
            "expected 1 and 1 (a disc); close handles or cut the face out of the head"
        )
    source, renumbered = without_unreferenced(xyz, closed)
    return CleanTemplate(xyz[source], renumbered, filled, source, xyz, len(holes))


def fill_hole(vertices: FloatArray, faces: IntArray, loop: IntArray) -> IntArray:
    """Return the (n - 2, 3) faces of least total area that close a loop (n,) of `boundary_loops`.

    The new faces run against the loop; the mesh's own edges are no chords. Dynamic programming (Barequet and
    Sharir, "Filling gaps in the boundary of a polyhedron", 1995), O(n^3): 500 vertices take a second.
    """
    ring = np.ascontiguousarray(loop[::-1])
    # Where the mesh has an edge between two vertices of the loop.
    place = np.full(len(vertices), -1)
    place[ring] = np.arange(len(ring))
    ends = place[faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)]
    ends = ends[(ends >= 0).all(1)]
    joined = np.zeros((len(ring), len(ring)), bool)
    joined[ends[:, 0], ends[:, 1]] = joined[ends[:, 1], ends[:, 0]] = True
    split = _least_area_splits(np.ascontiguousarray(vertices[ring]), joined)
    patch, pending = [], [(0, len(ring) - 1)]
    while pending:
        i, k = pending.pop()
        if k - i < 2:
            continue
        j = int(split[i, k])
        patch.append((ring[i], ring[j], ring[k]))
        pending += [(i, j), (j, k)]
    return np.array(patch, np.int64).reshape(-1, 3)


@njit(cache=True, nogil=True)
def _least_area_splits(points, joined):  # type: ignore[no-untyped-def]
    n = len(points)
    # More than any triangulation's area, so that a chord already in the mesh is the last resort.
    forbidden = n * np.sum((points - points[0]) ** 2)
    cost = np.zeros((n, n))
    split = np.zeros((n, n), np.int64)
    for span in range(2, n):
        for i in range(n - span):
            k = i + span
            best = np.inf
            for j in range(i + 1, k):
                area = 0.5 * np.linalg.norm(np.cross(points[j] - points[i], points[k] - points[i]))
                total = cost[i, j] + cost[j, k] + area
                if total < best:
                    best = total
                    split[i, k] = j
            cost[i, k] = best + (forbidden if joined[i, k] and span < n - 1 else 0.0)
    return split
