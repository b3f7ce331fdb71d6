"""Samples of the model's limit surface on which forces act."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.face_model.annotation import MOUTH_REGION
from scan2albedo.fitting.kernels import spring_product, surface_normals
from scan2albedo.geometry.mesh import boundary_vertex_mask, vertex_areas
from scan2albedo.geometry.operators import vertex_average

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RIM_MM = 30.0


@dataclass(frozen=True)
class SurfaceSamples:
    """Limit positions of the vertices of one refinement level.

    Parameters
    ----------
    matrix : (N, C) csr_matrix
        Sample positions from control points.
    faces : (F, 3) int64
        Triangles between the samples.
    parent : (F,) int64
        Control face of each triangle.
    area : (N,) float64
        mm^2 of skin each sample stands for; 0 on the film between the lips, which nothing pulls at.
    rigidity : (N,) float64
        Mean stiffness of the regions around each sample.
    rim : (N,) float64
        1 at the model's rim and up to RIM_MM / 2 from it, falling to 0 at RIM_MM: where hair and collars are.
    """

    matrix: sparse.csr_matrix
    faces: IntArray
    parent: IntArray
    area: FloatArray
    rigidity: FloatArray
    rim: FloatArray

    @classmethod
    def of(cls, model: AnnotatedFaceModel, control_points: FloatArray, level: int) -> SurfaceSamples:
        """Sample `model` at the limit vertices of `level` refinements, areas taken at `control_points`."""
        subdivision = model.subdivision(level)
        points = subdivision.matrix @ control_points
        film = model.in_region(MOUTH_REGION)[subdivision.parent].astype(float)
        skin = 1 - vertex_average(len(points), subdivision.faces, film)
        stiffness = model.region_values("stiffness")[model.region[subdivision.parent]]
        return cls(
            subdivision.matrix,
            subdivision.faces,
            subdivision.parent,
            skin * vertex_areas(points, subdivision.faces),
            vertex_average(len(points), subdivision.faces, stiffness),
            _rim(points, subdivision.faces),
        )

    def normals(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) unit normals of the sampled surface at positions (N, 3)."""
        return np.asarray(surface_normals(points, self.faces)[0])

    def product(self, stiffness: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Return x -> S^T H S x for displacements x (C, 3), H the stiffness (N, 6) at the samples."""
        matrix = self.matrix
        return lambda x: spring_product(x, matrix.indptr, matrix.indices, matrix.data, stiffness)


def _rim(points: FloatArray, faces: IntArray) -> FloatArray:
    border = points[boundary_vertex_mask(len(points), faces)]
    if len(border) == 0:
        return np.zeros(len(points))
    distance, _ = cKDTree(border).query(points, distance_upper_bound=RIM_MM)
    return np.clip(2 - 2 * distance / RIM_MM, 0, 1)
