"""Closest points on a triangle mesh through a tree of boxes; each search begins at the last answer."""

from __future__ import annotations

import numpy as np
from numba import njit

from scan2albedo.core.arrays import FloatArray, IntArray

LEAF_FACES = 4
"""Triangles of a box that is not divided further."""
_DEPTH = 64


class TriangleTree:
    """A binary tree of axis-aligned boxes around the triangles of one mesh with at least one.

    Boxes are divided at the median centre along their longest side, so the tree of F triangles is log2(F /
    LEAF_FACES) deep whatever their shape. A query starts with the distance to the triangle that the query
    before it found: neighbours in a list of texels or samples find their answers in a few boxes.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        corners = vertices[faces]
        low, high = corners.min(1), corners.max(1)
        self._order, self._first, self._count, self._right = _divided((low + high) / 2)
        self._corners = np.ascontiguousarray(corners[self._order])
        self._boxes = _boxes(low[self._order], high[self._order], self._first, self._count, self._right)

    def query(self, points: FloatArray) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
        """Return closest points (N, 3), faces (N,), barycentric weights (N, 3) and distances (N,).

        Points (N, 3) are finite; the search is fast when points near each other follow each other.
        """
        closest, weights = np.empty_like(points), np.empty_like(points)
        face, distance = np.empty(len(points), np.int64), np.empty(len(points))
        _nearest(
            points,
            self._corners,
            self._boxes,
            self._first,
            self._count,
            self._right,
            closest,
            face,
            weights,
            distance,
        )
        return closest, self._order[face], weights, distance


@njit(cache=True, nogil=True)
def _divided(centre):  # type: ignore[no-untyped-def]
    """Return the order (F,) of the triangles in the leaves; of each node its first, count and right child.

    The left child of node n is n + 1; leaves have no right child (-1).
    """
    total = len(centre)
    order = np.arange(total)
    first = np.empty(2 * total, np.int64)
    count = np.empty(2 * total, np.int64)
    right = np.full(2 * total, -1, np.int64)
    pending = np.empty((_DEPTH, 3), np.int64)  # first, end, parent whose right child it is (-1: none)
    pending[0] = 0, total, -1
    waiting, nodes = 1, 0
    while waiting > 0:
        waiting -= 1
        start, end, parent = pending[waiting]
        node, nodes = nodes, nodes + 1
        first[node], count[node] = start, end - start
        if parent >= 0:
            right[parent] = node
        if end - start <= LEAF_FACES:
            continue
        middle = (start + end) // 2
        _halve(order, centre, start, end, middle, _longest_axis(order, centre, start, end))
        # The right half waits below the left one, whose nodes follow this one at once.
        pending[waiting] = middle, end, node
        pending[waiting + 1] = start, middle, -1
        waiting += 2
    return order, first[:nodes].copy(), count[:nodes].copy(), right[:nodes].copy()


@njit(cache=True, nogil=True)
def _longest_axis(order, centre, start, end):  # type: ignore[no-untyped-def]
    """Return the axis along which the centres spread most."""
    axis, longest = 0, -1.0
    for k in range(3):
        low, high = np.inf, -np.inf
        for i in range(start, end):
            value = centre[order[i], k]
            low, high = min(low, value), max(high, value)
        if high - low > longest:
            axis, longest = k, high - low
    return axis


@njit(cache=True, nogil=True)
def _halve(order, centre, start, end, middle, axis):  # type: ignore[no-untyped-def]
    """Order [start, end) so that no centre before `middle` is above one after it (quickselect)."""
    low, high = start, end - 1
    while low < high:
        pivot = centre[order[(low + high) // 2], axis]
        i, j = low, high
        while i <= j:
            while centre[order[i], axis] < pivot:
                i += 1
            while centre[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i, j = i + 1, j - 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@njit(cache=True, nogil=True)
def _boxes(low, high, first, count, right):  # type: ignore[no-untyped-def]
    """Return (N, 6) the least and greatest corner of every node; children come after their parents."""
    boxes = np.empty((len(first), 6))
    for node in range(len(first) - 1, -1, -1):
        if right[node] < 0:
            for k in range(3):
                a, b = np.inf, -np.inf
                for i in range(first[node], first[node] + count[node]):
                    a, b = min(a, low[i, k]), max(b, high[i, k])
                boxes[node, k], boxes[node, k + 3] = a, b
        else:
            for k in range(3):
                boxes[node, k] = min(boxes[node + 1, k], boxes[right[node], k])
                boxes[node, k + 3] = max(boxes[node + 1, k + 3], boxes[right[node], k + 3])
    return boxes


@njit(cache=True, nogil=True)
def _squared_distance_to_box(x, y, z, boxes, node):  # type: ignore[no-untyped-def]
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _to_triangle(x, y, z, corners, f):  # type: ignore[no-untyped-def]
    """Return the squared distance of a point to triangle f and the weights of the closest point."""
    ax, ay, az = corners[f, 0, 0] - x, corners[f, 0, 1] - y, corners[f, 0, 2] - z
    bx, by, bz = corners[f, 1, 0] - x, corners[f, 1, 1] - y, corners[f, 1, 2] - z
    cx, cy, cz = corners[f, 2, 0] - x, corners[f, 2, 1] - y, corners[f, 2, 2] - z
    u, v, w = weights_nearest_origin(ax, ay, az, bx, by, bz, cx, cy, cz)
    px, py, pz = u * ax + v * bx + w * cx, u * ay + v * by + w * cy, u * az + v * bz + w * cz
    return px * px + py * py + pz * pz, u, v, w


@njit(cache=True, nogil=True)
def _nearest(points, corners, boxes, first, count, right, closest, face, weights, distance):  # type: ignore[no-untyped-def]
    stack = np.empty(_DEPTH, np.int64)
    gap = np.empty(_DEPTH)
    # Typed, since literals would have the functions below compiled again.
    root, found = np.int64(0), np.int64(0)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        best, u, v, w = _to_triangle(x, y, z, corners, found)
        stack[0], gap[0] = root, _squared_distance_to_box(x, y, z, boxes, root)
        waiting = 1
        while waiting > 0:
            waiting -= 1
            if gap[waiting] >= best:
                continue
            node = stack[waiting]
            while right[node] >= 0:
                near, far = node + 1, right[node]
                to_near = _squared_distance_to_box(x, y, z, boxes, near)
                to_far = _squared_distance_to_box(x, y, z, boxes, far)
                if to_far < to_near:
                    near, far, to_near, to_far = far, near, to_far, to_near
                if to_far < best:
                    stack[waiting], gap[waiting] = far, to_far
                    waiting += 1
                node = near
                if to_near >= best:
                    break
            if right[node] >= 0:
                continue
            for f in range(first[node], first[node] + count[node]):
                d, a, b, c = _to_triangle(x, y, z, corners, f)
                if d < best:
                    best, u, v, w, found = d, a, b, c, f  # type: ignore[assignment]
        face[i], distance[i] = found, np.sqrt(best)
        weights[i, 0], weights[i, 1], weights[i, 2] = u, v, w
        for k in range(3):
            closest[i, k] = u * corners[found, 0, k] + v * corners[found, 1, k] + w * corners[found, 2, k]


@njit(cache=True, nogil=True)
def weights_nearest_origin(ax, ay, az, bx, by, bz, cx, cy, cz):  # type: ignore[no-untyped-def]
    """Weights of the point of triangle abc nearest to the origin (Ericson, Real-Time Collision Detection)."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    d1, d2 = -(ux * ax + uy * ay + uz * az), -(vx * ax + vy * ay + vz * az)
    if d1 <= 0 and d2 <= 0:
        return 1.0, 0.0, 0.0
    d3, d4 = -(ux * bx + uy * by + uz * bz), -(vx * bx + vy * by + vz * bz)
    if d3 >= 0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    d5, d6 = -(ux * cx + uy * cy + uz * cz), -(vx * cx + vy * cy + vz * cz)
    if d6 >= 0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        t = d1 / max(d1 - d3, 1e-300)
        return 1 - t, t, 0.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        t = d2 / max(d2 - d6, 1e-300)
        return 1 - t, 0.0, t
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / max((d4 - d3) + (d5 - d6), 1e-300)
        return 0.0, 1 - t, t
    total = va + vb + vc
    if total <= 0:
        return 1.0, 0.0, 0.0
    return va / total, vb / total, vc / total
