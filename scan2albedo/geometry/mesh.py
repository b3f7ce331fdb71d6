"""Elementary quantities of a triangle mesh: normals, areas, boundaries, neighbours, components, thinning."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, dots, row_sums

_OBJECT_SHARE = 0.05


@dataclass(frozen=True)
class RayHits:
    """First hits: `face` (N,) with -1 for none, `barycentric` (N, 3), `distance` (N,) with inf for none."""

    face: IntArray
    barycentric: FloatArray
    distance: FloatArray


def face_cross_products(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F, 3) cross products of two edges of each face: normal direction, length twice the area."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(second - first, third - first)


def face_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F,) areas."""
    return lengths(face_cross_products(vertices, faces)) / 2


def lengths(vectors: FloatArray) -> FloatArray:
    """Return (...) lengths of vectors (..., 3), without the slow reduction over so short an axis."""
    return np.sqrt(dots(vectors, vectors))


def median_edge(vertices: FloatArray, faces: IntArray) -> float:
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
    corners, crosses = faces.ravel(), face_cross_products(vertices, faces)
    sums = [np.bincount(corners, np.repeat(part, 3), len(vertices)) for part in crosses.T]
    return normalized(np.stack(sums, 1))


def vertex_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (V,) barycentric areas: a third of each incident face's area."""
    thirds = np.repeat(face_areas(vertices, faces) / 3, 3)
    return np.bincount(faces.ravel(), thirds, minlength=len(vertices)).astype(float)


def face_edges(faces: IntArray) -> IntArray:
    """Return the corners (F, 3, 2) of the faces' sides, in the order in which they run around."""
    return faces[:, [[0, 1], [1, 2], [2, 0]]]


def edges_with_faces(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return unique undirected edges (E, 2) and, per edge, how many faces use it (E,)."""
    if len(faces) == 0:
        return np.zeros((0, 2), int), np.zeros(0, int)
    directed = face_edges(faces).reshape(-1, 2)
    # One integer an edge sorts ten times faster than rows do, in the same order.
    span = np.int64(faces.max()) + 1
    keys, counts = np.unique(directed.min(1) * span + directed.max(1), return_counts=True)
    return np.stack([keys // span, keys % span], 1), counts


def vertex_mask(vertex_count: int, index: IntArray) -> BoolArray:
    """Return (V,) True for the vertices that an index array of any shape names, such as those of faces."""
    mask = np.zeros(vertex_count, bool)
    mask[index] = True
    return mask


def boundary_vertex_mask(vertex_count: int, faces: IntArray) -> BoolArray:
    """Return (V,) True for vertices on an edge of exactly one face."""
    edges, counts = edges_with_faces(faces)
    return vertex_mask(vertex_count, edges[counts == 1])


def boundary_loops(faces: IntArray) -> list[IntArray]:
    """Return the boundary loops, longest (in vertices) first, in the direction of the faces' own edges."""
    import igl

    loops = [np.asarray(loop, int) for loop in igl.boundary_loop_all(np.asarray(faces, int))]
    return sorted(loops, key=len, reverse=True)


def adjacency(vertex_count: int, faces: IntArray) -> sparse.csr_matrix:
    """Return the symmetric (V, V) 0/1 adjacency of vertices joined by an edge."""
    index = np.ascontiguousarray(faces, int)
    require_vertices(index, vertex_count)
    start, end = index.ravel(), index[:, [1, 2, 0]].ravel()
    apart, shape = start != end, (vertex_count, vertex_count)
    joined = (np.ones(int(apart.sum()), bool), (start[apart], end[apart]))
    graph = sparse.coo_matrix(joined, shape=shape).tocsr()
    return (graph + graph.T).astype(float)


def neighbour_mean(vertex_count: int, faces: IntArray) -> sparse.csr_matrix:
    """Return the (V, V) matrix that averages values of each vertex and its neighbours."""
    around = adjacency(vertex_count, faces) + sparse.identity(vertex_count, format="csr")
    return sparse.diags(1 / row_sums(around)) @ around


def vertex_components(vertex_count: int, faces: IntArray) -> IntArray:
    """Return (V,) component labels 0..n-1 of vertices connected through faces, by their first vertex."""
    require_vertices(faces, vertex_count)
    edges = faces[:, :-1].ravel(), faces[:, 1:].ravel()
    graph = sparse.coo_matrix((np.ones(len(edges[0]), bool), edges), shape=(vertex_count, vertex_count))
    return connected_components(graph, directed=False)[1].astype(int)


def turned_against_neighbours(faces: IntArray) -> BoolArray:
    """Return (F,) True for the faces to reverse so that neighbours wind alike.

    In every part joined by edges of two faces the fewer faces are reversed. A one-sided part (a Moebius
    strip) has no such answer and stays as it is.

    >>> turned_against_neighbours(np.array([[0, 1, 2], [2, 1, 3], [2, 4, 3]])).tolist()
    [False, False, True]
    """
    first, second, same_winding = neighbouring_faces(faces)
    count = len(faces)
    if not same_winding.any():
        return np.zeros(count, bool)
    # Each face has two copies, as it is and reversed; neighbours are joined where they wind alike.
    rows = np.concatenate([first, first + count])
    columns = np.concatenate([second + count * same_winding, second + count * ~same_winding])
    graph = sparse.csr_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(2 * count, 2 * count))
    _, labels = connected_components(graph, directed=False)
    kept, reverse = labels[:count], labels[count:]
    part, side = np.minimum(kept, reverse), kept < reverse
    return np.where(np.bincount(part, np.where(side, 1.0, -1.0))[part] >= 0, ~side, side) & (kept != reverse)


def neighbouring_faces(faces: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Return pairs of faces that alone share an edge, and whether both run along it the same way."""
    start, end = faces.ravel().astype(int), faces[:, [1, 2, 0]].ravel().astype(int)
    key = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    begins = np.flatnonzero(np.diff(key[order], prepend=-1))
    pairs = begins[np.diff(begins, append=len(order)) == 2]
    one, other = order[pairs], order[pairs + 1]
    return one // 3, other // 3, start[one] == start[other]


def without_unreferenced(vertices: FloatArray, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return (kept vertex indices (K,), faces renumbered to them)."""
    used = vertex_mask(len(vertices), faces)
    return np.flatnonzero(used), (np.cumsum(used) - 1)[faces]


def far_vertices(vertices: FloatArray, used: BoolArray) -> BoolArray:
    """Return (V,) True for vertices 3 times farther from the median of those `used` than 75 % of them.

    Stereo puts up to a fifth of its vertices far away; the farthest of a head with shoulders lies at 2.1.
    """
    far = ~used
    for _ in range(10):
        distance = lengths(vertices - np.median(vertices[~far], axis=0))
        farther = distance > 3 * np.percentile(distance[~far], 75)
        if not (farther & ~far).any():
            break
        far |= farther
    return far & farther


def far_faces(vertices: FloatArray, faces: IntArray) -> BoolArray:
    """Return (F,) True for stray faces, which reach to `far_vertices`.

    Where such faces hang together and hold a twentieth of all vertices, they are a thing of their own.
    """
    used = vertex_mask(len(vertices), faces)
    far = far_vertices(vertices, used)
    reaching = far[faces].any(1)
    if not reaching.any() or reaching.all():
        return np.zeros(len(faces), bool)
    part = vertex_components(len(vertices), faces[far[faces].all(1)])
    return reaching & ~((np.bincount(part) >= _OBJECT_SHARE * used.sum())[part] & far)[faces].any(1)


def neighbour_lists(vertex_count: int, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return begins (V + 1,) and neighbours (N,): rows of the vertices joined to each by an edge, ascending.

    The neighbours of vertex v are ``neighbours[begins[v]:begins[v + 1]]``.
    """
    graph = adjacency(vertex_count, faces)
    return graph.indptr.astype(int), graph.indices.astype(int)


def face_lists(vertex_count: int, faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return (begins (V + 1,), around (3 F,)): vertex v is in faces ``around[begins[v]:begins[v + 1]]``."""
    index = np.ascontiguousarray(faces, int)
    require_vertices(index, vertex_count)
    corners = np.ones(index.size, bool), index.ravel(), np.arange(0, index.size + 1, 3)
    incidence = sparse.csr_matrix(corners, shape=(len(index), vertex_count)).tocsc()
    return incidence.indptr.astype(int), incidence.indices.astype(int)


def join(meshes: Sequence[tuple[FloatArray, IntArray]]) -> tuple[FloatArray, IntArray]:
    """Return one mesh holding all the given ones as loose parts, in order."""
    offsets = np.cumsum([0] + [len(v) for v, _ in meshes[:-1]])
    faces = np.concatenate([f + o for (_, f), o in zip(meshes, offsets, strict=True)])
    return np.concatenate([v for v, _ in meshes]), faces


def require_vertices(faces: IntArray, vertex_count: int) -> None:
    """Refuse faces that refer to a vertex that is not there."""
    if len(faces) and not (faces.min() >= 0 and faces.max() < vertex_count):
        raise IndexError(f"faces refer to vertices {faces.min()} to {faces.max()} of {vertex_count}")


@dataclass(frozen=True)
class ThinnedSurface:
    """A mesh of `faces` (F, 3) whose `vertices` (V, 3) are means of the `count` (V,) in one grid cell."""

    vertices: FloatArray
    faces: IntArray
    count: FloatArray

    @cached_property
    def boundary(self) -> BoolArray:
        """(V,) at edges of an odd number of faces: modulo 2 borders add up, which joining vertices keeps."""
        edges, uses = edges_with_faces(self.faces)
        return vertex_mask(len(self.vertices), edges[uses % 2 == 1])


def thinned(vertices: FloatArray, faces: IntArray, cell: float) -> ThinnedSurface:
    """Join the vertices that lie in the same cell of a grid; this closes seams.

    `cell` is the side of the grid's cells in the mesh's unit, at least a millionth of the mesh's size.
    """
    # With more along a side cells could not be numbered in 64 bits.
    cell = max(cell, float(np.ptp(vertices, axis=0).max()) / 2**20)
    place = np.floor((vertices - vertices.min(0)) / cell + 0.5).astype(int)
    span = place.max(0) + 1
    _, inverse = np.unique((place[:, 0] * span[1] + place[:, 1]) * span[2] + place[:, 2], return_inverse=True)
    cluster = inverse.ravel()
    count = np.bincount(cluster).astype(float)
    means = np.stack([np.bincount(cluster, vertices[:, axis]) / count for axis in range(3)], 1)
    joined = cluster[faces]
    a, b, c = joined.T
    return ThinnedSurface(means, joined[(a != b) & (b != c) & (c != a)], count)
