"""What lies around each vertex of a triangle mesh: its neighbours and its faces, as rows of one list."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

IntArray = NDArray[np.int64]

_LONG_ROW = 64
"""Neighbours, each as often as faces name it, from which insertion sorts them slower than `numpy.sort`."""


def neighbour_lists(vertex_count: int, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the vertices joined to each by an edge, ascending, each once.

    Parameters
    ----------
    vertex_count : int
    faces : (F, 3) int64
        Of vertices below `vertex_count`.

    Returns
    -------
    begins : (V + 1,) int64
    neighbours : (N,) int64
        Those of vertex v are ``neighbours[begins[v]:begins[v + 1]]``.
    """
    index = np.ascontiguousarray(faces, np.int64)
    require_vertices(index, vertex_count)
    ends = np.zeros(vertex_count + 1, np.int64)
    np.cumsum(2 * np.bincount(index.ravel(), minlength=vertex_count), out=ends[1:])
    every = np.empty(ends[-1], np.int64)
    _list_corners(index, ends[:-1].copy(), every)
    begins = np.zeros_like(ends)
    count = _sort_rows_once(ends, every, begins)
    return begins, every[:count].copy()


@njit(cache=True, nogil=True)
def _list_corners(faces, place, every):  # type: ignore[no-untyped-def]
    """Write both other corners of each face's corner to `every`, at the vertex's `place`, which moves on."""
    for i in range(len(faces)):
        for k in range(3):
            here = faces[i, k]
            every[place[here]] = faces[i, (k + 1) % 3]
            every[place[here] + 1] = faces[i, (k + 2) % 3]
            place[here] += 2


@njit(cache=True, nogil=True)
def _sort_rows_once(ends, every, begins):  # type: ignore[no-untyped-def]
    """Sort each row of `every` and drop what it holds twice, in place; write where rows begin, return N.

    By insertion, since rows are short; the part kept never overtakes the part read.
    """
    count = 0
    for v in range(len(ends) - 1):
        if ends[v + 1] - ends[v] > _LONG_ROW:
            every[ends[v] : ends[v + 1]] = np.sort(every[ends[v] : ends[v + 1]])
        for k in range(ends[v], ends[v + 1]):
            here, place = every[k], count
            while place > begins[v] and every[place - 1] > here:
                place -= 1
            if here == v or (place > begins[v] and every[place - 1] == here):
                continue
            for m in range(count, place, -1):
                every[m] = every[m - 1]
            every[place] = here
            count += 1
        begins[v + 1] = count
    return count


def face_lists(vertex_count: int, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the faces around each vertex, ascending.

    Parameters
    ----------
    vertex_count : int
    faces : (F, 3) int64
        Of vertices below `vertex_count`.

    Returns
    -------
    begins : (V + 1,) int64
    around : (3 F,) int64
        Those of vertex v are ``around[begins[v]:begins[v + 1]]``.
    """
    index = np.ascontiguousarray(faces, np.int64)
    require_vertices(index, vertex_count)
    begins = np.zeros(vertex_count + 1, np.int64)
    np.cumsum(np.bincount(index.ravel(), minlength=vertex_count), out=begins[1:])
    around = np.empty(index.size, np.int64)
    _list_faces(index, begins[:-1].copy(), around)
    return begins, around


@njit(cache=True, nogil=True)
def _list_faces(faces, place, around):  # type: ignore[no-untyped-def]
    """Write each face to `around` at the `place` of each of its corners, which moves on."""
    for i in range(len(faces)):
        for k in range(3):
            around[place[faces[i, k]]] = i
            place[faces[i, k]] += 1


def require_vertices(faces: IntArray, vertex_count: int) -> None:
    """Refuse faces that kernels would read and write past the end of."""
    if len(faces) and not (faces.min() >= 0 and faces.max() < vertex_count):
        raise IndexError(
            f"faces refer to vertices {faces.min()} to {faces.max()}, but there are {vertex_count}"
        )
