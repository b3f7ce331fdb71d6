"""The face model as registration sees it: samples with weights and its depth image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import RegistrationError
from scan2albedo.face_model.model import AnnotatedFaceModel
from scan2albedo.geometry.operators import vertex_average
from scan2albedo.geometry.oriented_points import OrientedPoints, oriented_points
from scan2albedo.registration.relief import FaceImage

_LEVELS = 1
_FEWEST_CONTROL_VERTICES = 20
_WEIGHT_RANGE = (0.2, 3.0)


@dataclass(frozen=True)
class Template:
    """Samples of the face model, in its frame, mm, in random order (a prefix is a fair sample).

    `rigidity` (M,) is area times stiffness relative to the mean: large on forehead and nose, small on lips
    and jaw. `front` (3,) is where the z axis leaves the face; `image` scores posed scans. `coarse_vertices`
    (C, 3) and `coarse_faces` (F, 3) are the limit surface at the control vertices, small enough to be drawn
    thousands of times, `coarse_stiffness` (C,) the relative stiffness there, clipped.
    """

    samples: OrientedPoints
    rigidity: FloatArray
    front: FloatArray
    image: FaceImage
    coarse_vertices: FloatArray
    coarse_faces: IntArray
    coarse_stiffness: FloatArray

    @classmethod
    def of(cls, model: AnnotatedFaceModel, spacing_mm: float, seed: int) -> Template:
        """Sample a model about every `spacing_mm`; too few control vertices raise a `RegistrationError`."""
        if len(model.control_vertices) < _FEWEST_CONTROL_VERTICES:
            raise RegistrationError(
                f"{model.name}: a model of {len(model.control_vertices)} control vertices has no relief "
                f"to find a face by; it needs at least {_FEWEST_CONTROL_VERTICES}, better some hundred"
            )
        vertices, faces = model.surface(_LEVELS)
        samples = oriented_points(vertices, faces, spacing_mm)
        samples = samples.subset(np.random.default_rng(seed).permutation(len(samples)))
        coarse_vertices, coarse_faces = model.surface(0)
        stiffness = _vertex_stiffness(model, len(coarse_vertices), coarse_faces)
        _, nearest = cKDTree(coarse_vertices).query(samples.points)
        middle = int(np.argmin(np.hypot(samples.points[:, 0], samples.points[:, 1])))
        return cls(
            samples,
            samples.areas * stiffness[nearest],
            samples.points[middle],
            FaceImage(vertices, faces),
            coarse_vertices,
            coarse_faces,
            stiffness,
        )

    def first(self, count: int) -> OrientedPoints:
        """Return the first `count` samples."""
        return self.samples.subset(np.arange(min(count, len(self.samples))))


def _vertex_stiffness(model: AnnotatedFaceModel, vertex_count: int, faces: IntArray) -> FloatArray:
    of_face = model.region_values("stiffness")[model.region]
    if of_face.mean() <= 0:
        return np.ones(vertex_count)
    return vertex_average(vertex_count, faces, np.clip(of_face / of_face.mean(), *_WEIGHT_RANGE))
