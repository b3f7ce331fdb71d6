"""Elementary quantities of a triangle mesh: normals, areas, boundaries, neighbours, components."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray

FAR_FACTOR, FAR_PERCENT, OBJECT_SHARE = 3.0, 75.0, 0.05


def face_cross_products(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F, 3) cross products of two edges of each face: normal direction, length twice the area."""
    crosses: FloatArray = _corner_crosses(np.ascontiguousarray(vertices[faces], np.float64))
    return crosses


@njit(cache=True, nogil=True)
def _corner_crosses(corners):  # type: ignore[no-untyped-def]
    """Return (F, 3) cross products of the first two edges of triangles (F, 3, 3)."""
    result = np.empty((len(corners), 3))
    for i in range(len(corners)):
        a, b, c = corners[i, 0], corners[i, 1], corners[i, 2]
        for k in range(3):
            m, n = (k + 1) % 3, (k + 2) % 3
            result[i, k] = (b[m] - a[m]) * (c[n] - a[n]) - (b[n] - a[n]) * (c[m] - a[m])
    return result


def face_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F,) areas."""
    return 0.5 * lengths(face_cross_products(vertices, faces))


def lengths(vectors: FloatArray) -> FloatArray:
    """Return (...) lengths of vectors (..., 3), without the slow reduction over so short an axis."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def usual_edge(vertices: FloatArray, faces: IntArray) -> float:
    """Return the median length of the faces' first edges."""
    return float(np.median(lengths(vertices[faces[:, 0]] - vertices[faces[:, 1]])))


def normalized(vectors: FloatArray) -> FloatArray:
    """Return the vectors (..., 3) at unit length; zero vectors stay zero."""
    length = lengths(vectors)[..., None]
    return vectors / np.where(length > 0, length, 1.0)


def face_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F, 3) unit normals; zero for zero-area faces."""
    return normalized(face_cross_products(vertices, faces))


def vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (V, 3) unit normals, faces weighted by area; zero where a vertex has no area around it."""
    sums = np.zeros((len(vertices), 3))
    _add_to_corners(face_cross_products(vertices, faces), np.ascontiguousarray(faces, np.int64), sums)
    return normalized(sums)


@njit(cache=True, nogil=True)
def _add_to_corners(values, faces, sums):  # type: ignore[no-untyped-def]
    """Add values (F, 3) of faces to `sums` (V, 3) at their corners."""
    for i in range(len(faces)):
        for corner in range(3):
            for k in range(3):
                sums[faces[i, corner], k] += values[i, k]


def vertex_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (V,) barycentric areas: a third of each incident face's area."""
    thirds = np.repeat(face_areas(vertices, faces) / 3, 3)
    return np.bincount(faces.ravel(), thirds, minlength=len(vertices)).astype(np.float64)


def edges_with_faces(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return unique undirected edges (E, 2) and, per edge, how many faces use it (E,)."""
    if len(faces) == 0:
        return np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    # One integer an edge sorts ten times faster than rows do, in the same order.
    span = np.int64(faces.max()) + 1
    keys, counts = np.unique(directed.min(1) * span + directed.max(1), return_counts=True)
    return np.stack([keys // span, keys % span], 1), counts


def boundary_edges(faces: IntArray) -> IntArray:
    """Return (B, 2) edges used by exactly one face."""
    edges, counts = edges_with_faces(faces)
    return edges[counts == 1]


def boundary_vertex_mask(vertex_count: int, faces: IntArray) -> BoolArray:
    """Return (V,) True for vertices on a boundary edge."""
    mask = np.zeros(vertex_count, bool)
    mask[boundary_edges(faces).ravel()] = True
    return mask


def boundary_loops(faces: IntArray) -> list[IntArray]:
    """Return the boundary loops, longest (in vertices) first, in the direction of the faces' own edges."""
    import igl

    loops = [np.asarray(loop, np.int64) for loop in igl.boundary_loop_all(np.asarray(faces, np.int64))]
    return sorted(loops, key=len, reverse=True)


def adjacency(vertex_count: int, faces: IntArray) -> sparse.csr_matrix:
    """Return the symmetric (V, V) 0/1 adjacency of vertices joined by an edge."""
    begins, neighbours = neighbour_lists(vertex_count, faces)
    joined = np.ones(len(neighbours))
    return sparse.csr_matrix((joined, neighbours, begins), shape=(vertex_count, vertex_count))


def vertex_components(vertex_count: int, faces: IntArray) -> IntArray:
    """Return (V,) component labels 0..n-1 of vertices connected through faces."""
    index = np.ascontiguousarray(faces, np.int64)
    require_vertices(index, vertex_count)
    labels: IntArray = _component_labels(vertex_count, index)
    return labels


@njit(cache=True, nogil=True)
def _component_labels(count, faces):  # type: ignore[no-untyped-def]
    """Return (V,) labels by union and find; each part's root is its first vertex."""
    parent = np.arange(count)
    for i in range(len(faces)):
        for k in range(2):
            a, b = faces[i, k], faces[i, k + 1]
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            if a < b:
                parent[b] = a
            else:
                parent[a] = b
    labels, found = np.empty(count, np.int64), 0
    for v in range(count):
        if parent[v] == v:
            labels[v] = found
            found += 1
        else:
            labels[v] = labels[parent[v]]
    return labels


def turned_against_neighbours(faces: IntArray) -> BoolArray:
    """Return (F,) True for the faces to reverse so that neighbours wind alike.

    In every part joined by edges of two faces the fewer faces are reversed. A one-sided part (a Moebius
    strip) has no such answer and stays as it is.

    >>> turned_against_neighbours(np.array([[0, 1, 2], [2, 1, 3], [2, 4, 3]])).tolist()
    [False, False, True]
    """
    first, second, alike = neighbouring_faces(faces)
    count = len(faces)
    if not alike.any():
        return np.zeros(count, bool)
    # Each face has two copies, as it is and reversed; neighbours are joined where they wind alike.
    rows = np.concatenate([first, first + count])
    columns = np.concatenate([second + count * alike, second + count * ~alike])
    graph = sparse.csr_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(2 * count, 2 * count))
    _, labels = connected_components(graph, directed=False)
    kept, reverse = labels[:count], labels[count:]
    part, side = np.minimum(kept, reverse), kept < reverse
    balance = np.bincount(part, np.where(side, 1.0, -1.0))
    return np.where(balance[part] >= 0, ~side, side) & (kept != reverse)


def neighbouring_faces(faces: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Return pairs of faces that alone share an edge, and whether both run along it the same way."""
    start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
    key = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    begins = np.flatnonzero(np.diff(key[order], prepend=-1))
    pairs = begins[np.diff(begins, append=len(order)) == 2]
    one, other = order[pairs], order[pairs + 1]
    return one // 3, other // 3, start[one] == start[other]


def without_unreferenced(vertices: FloatArray, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return (kept vertex indices (K,), faces renumbered to them)."""
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    kept = np.flatnonzero(used)
    renumber = np.full(len(vertices), -1, np.int64)
    renumber[kept] = np.arange(len(kept))
    return kept, renumber[faces]


def far_vertices(vertices: FloatArray, used: BoolArray) -> BoolArray:
    """Return (V,) True for vertices 3 times farther from the median of those `used` than 75 % of them.

    Stereo puts up to a fifth of its vertices far away; the farthest of a head with shoulders lies at 2.1
    times.
    """
    far = ~used
    for _ in range(10):
        near = vertices[~far]
        distance = lengths(vertices - np.median(near, axis=0))
        farther = distance > FAR_FACTOR * np.percentile(distance[~far], FAR_PERCENT)
        if not (farther & ~far).any():
            break
        far |= farther
    return far & farther


def far_faces(vertices: FloatArray, faces: IntArray) -> BoolArray:
    """Return (F,) True for stray faces, which reach to `far_vertices`.

    Where such faces hang together and hold a twentieth of all vertices, they are a thing of their own.
    """
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    far = far_vertices(vertices, used)
    reaching = far[faces].any(1)
    if not reaching.any() or reaching.all():
        return np.zeros(len(faces), bool)
    part = vertex_components(len(vertices), faces[far[faces].all(1)])
    large = np.bincount(part) >= OBJECT_SHARE * used.sum()
    return reaching & ~(large[part] & far)[faces].any(1)


def neighbour_lists(vertex_count: int, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return begins (V + 1,) and neighbours (N,): rows of the vertices joined to each by an edge, ascending.

    The neighbours of vertex v are ``neighbours[begins[v]:begins[v + 1]]``.
    """
    index = np.ascontiguousarray(faces, np.int64)
    require_vertices(index, vertex_count)
    ends = np.zeros(vertex_count + 1, np.int64)
    np.cumsum(2 * np.bincount(index.ravel(), minlength=vertex_count), out=ends[1:])
    every = np.empty(ends[-1], np.int64)
    _list_corners(index, ends[:-1].copy(), every)
    # From about 64 on insertion is slower than `numpy.sort`.
    for long in np.flatnonzero(np.diff(ends) > 64):
        every[ends[long] : ends[long + 1]].sort()
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
    """Sort each row of `every` and drop duplicates, in place; write where rows begin, return N.

    By insertion, since rows are short or sorted before; the write position never overtakes the read position.
    """
    count = 0
    for v in range(len(ends) - 1):
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
    """Return (begins (V + 1,), around (3 F,)): vertex v is in faces ``around[begins[v]:begins[v + 1]]``."""
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
