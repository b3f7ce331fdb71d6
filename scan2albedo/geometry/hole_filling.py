"""Close holes of a triangle mesh with the triangulation of least area."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def boundary_loops(faces: IntArray) -> list[IntArray]:
    """Return the boundary loops, longest (in vertices) first, in the direction of the faces' own edges."""
    import igl

    loops = [np.asarray(loop, np.int64) for loop in igl.boundary_loop_all(np.asarray(faces, np.int64))]
    return sorted(loops, key=len, reverse=True)


def fill_hole(vertices: FloatArray, faces: IntArray, loop: IntArray) -> IntArray:
    """Return the (n - 2, 3) faces of least total area that close a loop of n vertices.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int64
        The mesh with the hole; its edges are not used again as chords, which would join three faces.
    loop : (n,) int64
        Boundary loop in the direction of the faces' edges (`boundary_loops`); the new faces run
        against it, so that the mesh stays consistently oriented.

    Notes
    -----
    Dynamic programming over polygon chords, O(n^3): 74 vertices take a millisecond, 500 a second.

    References
    ----------
    .. [1] G. Barequet, M. Sharir, "Filling gaps in the boundary of a polyhedron", 1995.
    """
    ring = np.ascontiguousarray(loop[::-1])
    split = _least_area_splits(np.ascontiguousarray(vertices[ring]), _joined(len(vertices), faces, ring))
    patch, pending = [], [(0, len(ring) - 1)]
    while pending:
        i, k = pending.pop()
        if k - i < 2:
            continue
        j = int(split[i, k])
        patch.append((ring[i], ring[j], ring[k]))
        pending += [(i, j), (j, k)]
    return np.array(patch, np.int64).reshape(-1, 3)


def _joined(vertex_count: int, faces: IntArray, ring: IntArray) -> NDArray[np.bool_]:
    """Return (n, n) True where the mesh has an edge between two vertices of the loop."""
    place = np.full(vertex_count, -1)
    place[ring] = np.arange(len(ring))
    ends = place[faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)]
    ends = ends[(ends >= 0).all(1)]
    joined = np.zeros((len(ring), len(ring)), bool)
    joined[ends[:, 0], ends[:, 1]] = joined[ends[:, 1], ends[:, 0]] = True
    return joined


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
