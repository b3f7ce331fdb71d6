"""The face model as registration sees it: samples with weights and modes, and its depth image."""

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

_WEIGHT_RANGE = (0.2, 3.0)


@dataclass(frozen=True)
class Template:
    """Samples of the face model, in its frame, mm, in random order (a prefix is a fair sample).

    `rigidity` (M,) is area times stiffness relative to the mean. `modes` (M, 3, K) are how people differ
    there, `control_modes` (K, C, 3) at the control points, which `surface_from_control` (V, C) takes to the
    vertices of `image`. `front` (3,) is the model's. `coarse_vertices` (C, 3) and `coarse_faces` (F, 3) are
    the limit surface at the control vertices, `coarse_stiffness` (C,) the clipped relative stiffness there.
    """

    samples: OrientedPoints
    rigidity: FloatArray
    modes: FloatArray
    front: FloatArray
    image: FaceImage
    coarse_vertices: FloatArray
    coarse_faces: IntArray
    coarse_stiffness: FloatArray
    control_modes: FloatArray
    surface_from_control: csr_matrix
    coarse_from_control: csr_matrix

    @classmethod
    def of(cls, model: AnnotatedSurface, seed: int) -> Template:
        """Sample a model about every 6 mm; too few control vertices raise a `RegistrationError`.

        The answer is kept for as long as the model is.
        """
        key = (id(model), seed)
        if key in _KNOWN:
            return _KNOWN[key]
        if (count := len(model.control_vertices)) < 20:
            said = f"{model.name}: a model of {count} control vertices has no relief to find a face by"
            raise RegistrationError(f"{said}; at least 20 are needed, better some hundred")
        vertices, faces = model.surface(1)
        samples = oriented_points(vertices, faces, 6)
        samples = samples.subset(np.random.default_rng(seed).permutation(len(samples)))
        coarse_vertices, coarse_faces = model.surface(0)
        stiffness, of_face = np.ones(len(coarse_vertices)), model.region_values("stiffness")[model.region]
        if (mean := of_face.mean()) > 0:
            relative = np.clip(of_face / mean, *_WEIGHT_RANGE)
            stiffness = vertex_average(len(coarse_vertices), coarse_faces, relative)
        _, nearest = cKDTree(coarse_vertices).query(samples.points)
        rigidity = samples.areas * stiffness[nearest]
        # Its square: what moves with an expression shall not turn the rest, however large it is.
        steadiness = np.zeros(len(coarse_vertices))
        np.add.at(steadiness, nearest, rigidity * stiffness[nearest])
        modes, matrix = shape_modes(model, steadiness), model.subdivision(1).matrix
        _, point = cKDTree(vertices).query(samples.points)
        at_samples = matrix[point] @ modes.transpose(1, 2, 0).reshape(len(coarse_vertices), -1)
        _KNOWN[key] = cls(
            samples,
            rigidity,
            at_samples.reshape(len(samples), 3, len(modes)),
            model.front,
            FaceImage(vertices, faces),
            coarse_vertices,
            coarse_faces,
            stiffness,
            modes,
            matrix,
            model.subdivision(0).matrix,
        )
        weakref.finalize(model, _KNOWN.pop, key, None)
        return _KNOWN[key]

    def in_shape(self, coefficients: FloatArray) -> Template:
        """Return the template moved by its modes times coefficients (K,); normals and image stay."""
        moved = np.tensordot(coefficients, self.control_modes, 1)
        return replace(
            self,
            samples=replace(self.samples, points=self.samples.points + self.modes @ coefficients),
            coarse_vertices=self.coarse_vertices + self.coarse_from_control @ moved,
        )

    def first(self, count: int) -> Template:
        """Return the template with its first `count` samples."""
        chosen = np.arange(min(count, len(self.samples)))
        rigidity, modes = self.rigidity[chosen], self.modes[chosen]
        return replace(self, samples=self.samples.subset(chosen), rigidity=rigidity, modes=modes)


_KNOWN: dict[tuple[int, int], Template] = {}
"""By the identity of the model and seed: thousands of scans are registered with one model."""
