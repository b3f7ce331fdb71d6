"""The face model as registration sees it: samples with weights and its depth image."""

from __future__ import annotations

import weakref
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import RegistrationError
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.variation import shape_modes
from scan2albedo.geometry.operators import vertex_average
from scan2albedo.geometry.oriented_points import OrientedPoints, oriented_points
from scan2albedo.registration.relief import FaceImage

_LEVELS = 1
_FEWEST_CONTROL_VERTICES = 20
_WEIGHT_RANGE = (0.2, 3.0)


@dataclass(frozen=True)
class Modes:
    """How people differ from the model: `shape_modes` at the samples (N, 3, K) and control points (K, C, 3).

    `surface_from_control` (V, C) and `coarse_from_control` (C, C) give the surfaces of moved control points.
    """

    at_samples: FloatArray
    control: FloatArray
    surface_from_control: csr_matrix
    coarse_from_control: csr_matrix

    def __len__(self) -> int:
        return self.at_samples.shape[2]

    def of_surface(self, coefficients: FloatArray) -> FloatArray:
        """Return by how much (V, 3) coefficients (K,) move the surface's points."""
        return self.surface_from_control @ np.tensordot(coefficients, self.control, 1)

    def of_coarse(self, coefficients: FloatArray) -> FloatArray:
        """Return by how much (C, 3) coefficients (K,) move the coarse surface's points."""
        return self.coarse_from_control @ np.tensordot(coefficients, self.control, 1)


@dataclass(frozen=True)
class Template:
    """Samples of the face model, in its frame, mm, in random order (a prefix is a fair sample).

    `rigidity` (M,) is area times stiffness relative to the mean: large on forehead and nose, small on lips
    and jaw. `front` (3,) is the model's; `image` scores posed scans. `coarse_vertices`
    (C, 3) and `coarse_faces` (F, 3) are the limit surface at the control vertices, small enough to be drawn
    thousands of times, `coarse_stiffness` (C,) the relative stiffness there, clipped. `modes` are how people
    differ.
    """

    samples: OrientedPoints
    rigidity: FloatArray
    front: FloatArray
    image: FaceImage
    coarse_vertices: FloatArray
    coarse_faces: IntArray
    coarse_stiffness: FloatArray
    modes: Modes

    @classmethod
    def of(cls, model: AnnotatedSurface, spacing_mm: float, seed: int) -> Template:
        """Sample a model about every `spacing_mm`; too few control vertices raise a `RegistrationError`.

        The answer is kept for as long as the model is.
        """
        key = (id(model), spacing_mm, seed)
        if key not in _KNOWN:
            _KNOWN[key] = cls._sampled(model, spacing_mm, seed)
            weakref.finalize(model, _KNOWN.pop, key, None)
        return _KNOWN[key]

    @classmethod
    def _sampled(cls, model: AnnotatedSurface, spacing_mm: float, seed: int) -> Template:
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
        rigidity = samples.areas * stiffness[nearest]
        # Its square: what moves with an expression shall not turn the rest, however large it is.
        steadiness = np.zeros(len(coarse_vertices))
        np.add.at(steadiness, nearest, rigidity * stiffness[nearest])
        modes, matrix = shape_modes(model, steadiness), model.subdivision(_LEVELS).matrix
        _, point = cKDTree(vertices).query(samples.points)
        at_samples = (matrix[point] @ modes.transpose(1, 2, 0).reshape(len(coarse_vertices), -1)).reshape(
            len(samples), 3, len(modes)
        )
        return cls(
            samples,
            rigidity,
            model.front,
            FaceImage(vertices, faces),
            coarse_vertices,
            coarse_faces,
            stiffness,
            Modes(at_samples, modes, matrix, model.subdivision(0).matrix),
        )

    def in_shape(self, coefficients: FloatArray) -> Template:
        """Return the template moved by its modes times coefficients (K,); normals and image stay."""
        return replace(
            self,
            samples=replace(self.samples, points=self.samples.points + self.modes.at_samples @ coefficients),
            coarse_vertices=self.coarse_vertices + self.modes.of_coarse(coefficients),
        )

    def first(self, count: int) -> OrientedPoints:
        """Return the first `count` samples."""
        return self.samples.subset(np.arange(min(count, len(self.samples))))


_KNOWN: dict[tuple[int, float, int], Template] = {}
"""By the identity of the model, spacing and seed: thousands of scans are registered with one model."""


def _vertex_stiffness(model: AnnotatedSurface, vertex_count: int, faces: IntArray) -> FloatArray:
    of_face = model.region_values("stiffness")[model.region]
    if of_face.mean() <= 0:
        return np.ones(vertex_count)
    return vertex_average(vertex_count, faces, np.clip(of_face / of_face.mean(), *_WEIGHT_RANGE))
