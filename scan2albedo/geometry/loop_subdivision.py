"""Loop subdivision as sparse matrices: refinement, limit positions, points on the limit surface."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import FloatArray, IntArray, row_sums
from scan2albedo.geometry.mesh import adjacency, edges_with_faces, face_edges, vertex_mask


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a mesh or its limit surface: control faces (N,) and weights (N, 3) of their corners."""

    face: IntArray
    barycentric: FloatArray

    def __len__(self) -> int:
        return len(self.face)


@dataclass(frozen=True)
class LoopSubdivision:
    """`levels` Loop refinements of a control mesh, the result pushed to the limit surface.

    For control positions P (C, 3), ``matrix @ P`` (V, 3) lies exactly on the limit surface; rows of `matrix`
    sum to 1. Children of control face f are rows f 4^levels ... (f + 1) 4^levels - 1 of `faces` (F 4^levels,
    3); `parent` (F 4^levels,) is the control face of each.
    """

    faces: IntArray
    matrix: sparse.csr_matrix
    parent: IntArray
    levels: int

    @classmethod
    def of(cls, vertex_count: int, faces: IntArray, levels: int) -> Self:
        """Build the matrices for a control mesh with `vertex_count` vertices."""
        matrix = sparse.identity(vertex_count, format="csr")
        refined = np.asarray(faces, int)
        for _ in range(levels):
            step, refined = refine(matrix.shape[0], refined)
            matrix = step @ matrix
        limit = limit_matrix(matrix.shape[0], refined)
        return cls(refined, (limit @ matrix).tocsr(), np.repeat(np.arange(len(faces)), 4**levels), levels)

    def points_matrix(self, points: SurfacePoints) -> sparse.csr_matrix:
        """Return the (N, C) matrix that evaluates the refined limit mesh at `points`, linear inside faces."""
        face, barycentric = np.asarray(points.face, int), np.array(points.barycentric, float)
        for _ in range(self.levels):
            # The child that holds the point: corner child k keeps corner k and its two edges' middles, the
            # middle one has corners (mid 01, mid 12, mid 20), each weight 1 - 2 b of the opposite corner.
            row, corner = np.arange(len(face)), np.argmax(barycentric, axis=1)
            inner = barycentric[row, corner] < 0.5
            outer = 2 * barycentric
            outer[row, corner] -= 1
            barycentric = np.where(inner[:, None], 1 - 2 * barycentric[:, [2, 0, 1]], outer)
            face = 4 * face + np.where(inner, 3, corner)
        places = np.repeat(np.arange(len(face)), 3), self.faces[face].ravel()
        shape = len(face), self.matrix.shape[0]
        interpolate = sparse.csr_matrix((barycentric.ravel(), places), shape=shape)
        return (interpolate @ self.matrix).tocsr()

    def control_points(self, points: SurfacePoints) -> SurfacePoints:
        """Return points given on the refined faces as points on the control faces; undoes `points_matrix`."""
        face, barycentric = np.asarray(points.face, int), np.array(points.barycentric, float)
        for _ in range(self.levels):
            row, child = np.arange(len(face)), face % 4
            outer = barycentric / 2
            outer[row, np.minimum(child, 2)] += 0.5
            middle = (1 - barycentric[:, [1, 2, 0]]) / 2
            face, barycentric = face // 4, np.where((child == 3)[:, None], middle, outer)
        return SurfacePoints(face, barycentric)


def refine(vertex_count: int, faces: IntArray) -> tuple[sparse.csr_matrix, IntArray]:
    """Return one Loop refinement [1]_: the (V', V) matrix and the (4F, 3) faces.

    Old vertices come first, then one vertex per edge. Face f has children 4f + k: corner k for k = 0, 1, 2
    (corner k stays at position k, the edge midpoints stand at the other corners), and the middle one for k =
    3 with corners (mid 01, mid 12, mid 20).

    Interior edge: 3/8 of its ends, 1/8 of the opposite corners. Interior vertex of valence n: (1 - n beta) v
    + beta sum, beta = (5/8 - (3/8 + cos(2 pi / n) / 4)^2) / n. Boundary: the cubic B-spline rules (1/2, 1/2)
    and (1/8, 3/4, 1/8). Edges of three and more faces are treated as boundary.

    .. [1] C. Loop, "Smooth Subdivision Surfaces Based on Triangles", 1987.
    """
    ends = face_edges(faces).reshape(-1, 2).astype(int)
    numbers = ends.min(1) * vertex_count + ends.max(1)
    keys, edge_of, uses = np.unique(numbers, return_inverse=True, return_counts=True)
    edges = np.stack([keys // vertex_count, keys % vertex_count], 1)
    edge_of = edge_of.reshape(-1, 3)
    boundary = uses != 2
    index, opposite = np.arange(len(edges)), faces[:, [2, 0, 1]].ravel()
    end_weight, inner = np.where(boundary, 0.5, 0.375), ~boundary[edge_of.ravel()]
    rows = np.concatenate([index, index, edge_of.ravel()[inner]])
    columns = np.concatenate([edges[:, 0], edges[:, 1], opposite[inner]])
    weights = np.concatenate([end_weight, end_weight, np.full(inner.sum(), 0.125)])
    edge_rows = sparse.csr_matrix((weights, (rows, columns)), shape=(len(edges), vertex_count))
    vertex_rows = _one_ring_rule(vertex_count, faces, edges[boundary], lambda n: _n_beta(n) / n, 0.125)
    a, b, c = faces.T
    ab, bc, ca = (vertex_count + edge_of).T
    children = np.stack([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))], 1)
    return sparse.vstack([vertex_rows, edge_rows]).tocsr(), children.reshape(-1, 3)


def _n_beta(valence: FloatArray) -> FloatArray:
    return 0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / valence)) ** 2


def limit_matrix(vertex_count: int, faces: IntArray) -> sparse.csr_matrix:
    """Return the (V, V) matrix that moves vertices to their limit positions.

    Interior vertex of valence n: (1 - n chi) v + chi sum, 1 / chi = 3 / (8 beta) + n with `refine`'s beta;
    boundary: (1/6, 2/3, 1/6) (the cubic B-spline's limit).
    """
    edges, uses = edges_with_faces(faces)
    boundary = edges[uses != 2]
    return _one_ring_rule(vertex_count, faces, boundary, lambda n: 1 / (0.375 * n / _n_beta(n) + n), 1 / 6)


def _one_ring_rule(vertex_count, faces, boundary, weight_of, boundary_neighbour):  # type: ignore[no-untyped-def]
    """Rows (1 - sum w) v + w sum over the one-ring, and the two-neighbour rule on the boundary."""
    ring = adjacency(vertex_count, faces)
    valence = row_sums(ring)
    on_boundary = vertex_mask(vertex_count, boundary)
    # An unreferenced vertex has no ring and stays where it is.
    interior = sparse.diags(np.where(on_boundary, 0.0, weight_of(np.maximum(valence, 1.0)))) @ ring
    ends = np.concatenate([boundary, boundary[:, ::-1]])
    along = sparse.csr_matrix((np.full(len(ends), boundary_neighbour), ends.T), shape=(vertex_count,) * 2)
    total = (interior + along).tocsr()
    return (total + sparse.diags(1 - row_sums(total))).tocsr()
