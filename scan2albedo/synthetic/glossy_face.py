"""The true face behind synthetic pictures, as a mesh of any of the model's levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.synthetic.glossy_person import GlossyPerson

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class GlossyFace:
    """A face and its reflectance, in the frame of the face model, mm.

    Parameters
    ----------
    vertices, normals : (V, 3) float64
    faces : (F, 3) int64
    landmarks : (68, 3) float64
    diffuse_linear, weights : (V, 3) float64
        True albedo, and true weights of the Blinn-Phong lobes with exponents 1, 8 and 64.
    """

    vertices: FloatArray
    normals: FloatArray
    faces: IntArray
    landmarks: FloatArray
    diffuse_linear: FloatArray
    weights: FloatArray

    @classmethod
    def truth_of(cls, person: GlossyPerson, levels: int) -> GlossyFace:
        """Return the face of a person after so many levels of subdivision."""
        sitter = person.sitter
        subdivision = sitter.model.subdivision(levels)
        # Vertices of coarser levels are the first ones of finer levels.
        count = subdivision.matrix.shape[0]
        return GlossyFace(
            sitter.face.vertices[:count],
            sitter.normals[:count],
            subdivision.faces,
            sitter.face.landmarks,
            person.diffuse_linear[:count],
            person.weights[:count],
        )
