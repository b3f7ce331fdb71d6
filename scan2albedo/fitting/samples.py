"""Samples of the model's limit surface on which forces act."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray, IntArray, dots
from scan2albedo.core.compiled import compiled, triple
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import MOUTH_REGION
from scan2albedo.geometry.mesh import boundary_vertex_mask, normalized, vertex_areas
from scan2albedo.geometry.operators import vertex_average
from scan2albedo.geometry.rigid import cross, dot, minus

RIM_MM = 30.0
_LEAST_RELIEF = 0.1
"""What a flat sample still counts for."""
_MOST_RELIEF = 0.3
"""Turn of the normals (1 - cosine) beyond which none counts more: nose, lids, lips and ears reach it."""


@dataclass(frozen=True)
class SurfaceSamples:
    """Limit positions of the vertices of one refinement level.

    `matrix` (N, C) gives sample positions from control points; `faces` (F, 3) are triangles between samples,
    `parent` (F,) their control faces. `area` (N,) is the mm^2 of skin, 0 on the film between the lips;
    `rigidity` (N,) the mean stiffness around; `rim` (N,) falls from 1 at RIM_MM / 2 from the model's rim to 0
    at RIM_MM.
    """

    matrix: sparse.csr_matrix
    faces: IntArray
    parent: IntArray
    area: FloatArray
    rigidity: FloatArray
    rim: FloatArray

    @classmethod
    def of(cls, model: AnnotatedSurface, control_points: FloatArray, level: int) -> Self:
        """Sample `model` at the limit vertices of `level` refinements, areas taken at `control_points`."""
        subdivision = model.subdivision(level)
        points = subdivision.matrix @ control_points
        film = model.in_region(MOUTH_REGION)[subdivision.parent].astype(float)
        skin = 1 - vertex_average(len(points), subdivision.faces, film)
        stiffness = model.region_values("stiffness")[model.region[subdivision.parent]]
        border = points[boundary_vertex_mask(len(points), subdivision.faces)]
        rim = np.zeros(len(points))
        if len(border):
            distance, _ = cKDTree(border).query(points, distance_upper_bound=RIM_MM)
            rim = np.clip(2 - 2 * distance / RIM_MM, 0, 1)
        area = skin * vertex_areas(points, subdivision.faces)
        rigidity = vertex_average(len(points), subdivision.faces, stiffness)
        return cls(subdivision.matrix, subdivision.faces, subdivision.parent, area, rigidity, rim)

    def normals(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) unit normals of the sampled surface at positions (N, 3)."""
        return surface_normals(points, self.faces)[0]

    def relief(self, points: FloatArray) -> FloatArray:
        """Return (N,) 1 - cosine, limited, between each normal and the mean of those within 15 mm."""
        normals = self.normals(points)
        tree = cKDTree(points)
        near = tree.sparse_distance_matrix(tree, RIM_MM / 2, output_type="coo_matrix")
        shape = (len(points), len(points))
        # The matrix leaves out distances of zero: each sample itself.
        around = sparse.coo_matrix((self.area[near.col], (near.row, near.col)), shape).tocsr()
        mean = normalized(around @ normals + self.area[:, None] * normals)
        return _LEAST_RELIEF + np.minimum(1 - dots(normals, mean), _MOST_RELIEF)

    def product(self, stiffness: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Return x -> S^T H S x for displacements x (C, 3), H the stiffness (N, 6) at the samples."""
        matrix = self.matrix
        return lambda x: spring_product(x, matrix.indptr, matrix.indices, matrix.data, stiffness)


@compiled
def surface_normals(points, faces):  # type: ignore[no-untyped-def]
    """Return (N, 3) unit vertex normals and (F, 3) unit face normals; zero where there is no area."""
    vertex, face = np.zeros((len(points), 3)), np.zeros((len(faces), 3))
    for f in range(len(faces)):
        i, j, k = triple(faces, f)
        first = triple(points, i)
        n = cross(minus(triple(points, j), first), minus(triple(points, k), first))
        for v in (i, j, k):
            for c in range(3):
                vertex[v, c] += n[c]
        length = np.sqrt(dot(n, n))
        if length > 0:
            face[f] = n[0] / length, n[1] / length, n[2] / length
    for v in range(len(vertex)):
        n = triple(vertex, v)
        length = np.sqrt(dot(n, n))
        if length > 0:
            for k in range(3):
                vertex[v, k] /= length
    return vertex, face


@compiled
def spring_product(x, start, column, value, stiffness):  # type: ignore[no-untyped-def]
    """Return S^T H S x for x (C, 3), S (N, C) in CSR form, H the stiffness (N, 6) of each sample."""
    result = np.zeros_like(x)
    for i in range(len(stiffness)):
        xx, yy, zz = triple(stiffness, i)
        if xx + yy + zz == 0.0:
            continue
        xy, xz, yz = stiffness[i, 3], stiffness[i, 4], stiffness[i, 5]
        px = 0.0
        py = 0.0
        pz = 0.0
        for r in range(start[i], start[i + 1]):
            c, s = column[r], value[r]
            px += s * x[c, 0]
            py += s * x[c, 1]
            pz += s * x[c, 2]
        qx, qy, qz = xx * px + xy * py + xz * pz, xy * px + yy * py + yz * pz, xz * px + yz * py + zz * pz
        for r in range(start[i], start[i + 1]):
            c, s = column[r], value[r]
            result[c, 0] += s * qx
            result[c, 1] += s * qy
            result[c, 2] += s * qz
    return result
