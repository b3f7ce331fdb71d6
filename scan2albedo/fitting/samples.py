"""Samples of the model's limit surface on which forces act."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.fitting.kernels import spring_product, surface_normals
from scan2albedo.geometry.mesh import vertex_areas
from scan2albedo.geometry.operators import vertex_average

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


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
        mm^2 of surface each sample stands for.
    rigidity : (N,) float64
        Mean stiffness of the regions around each sample.
    """

    matrix: sparse.csr_matrix
    faces: IntArray
    parent: IntArray
    area: FloatArray
    rigidity: FloatArray

    @classmethod
    def of(cls, model: AnnotatedFaceModel, control_points: FloatArray, level: int) -> SurfaceSamples:
        """Sample `model` at the limit vertices of `level` refinements, areas taken at `control_points`."""
        subdivision = model.subdivision(level)
        points = subdivision.matrix @ control_points
        stiffness = model.region_values("stiffness")[model.region[subdivision.parent]]
        return cls(
            subdivision.matrix,
            subdivision.faces,
            subdivision.parent,
            vertex_areas(points, subdivision.faces),
            vertex_average(len(points), subdivision.faces, stiffness),
        )

    def normals(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) unit normals of the sampled surface at positions (N, 3)."""
        return np.asarray(surface_normals(points, self.faces)[0])

    def product(self, stiffness: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Return x -> S^T H S x for displacements x (C, 3), H the stiffness (N, 6) at the samples."""
        matrix = self.matrix
        return lambda x: spring_product(x, matrix.indptr, matrix.indices, matrix.data, stiffness)
