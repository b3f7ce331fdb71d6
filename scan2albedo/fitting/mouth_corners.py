"""Pull the model's mouth corners before it bends, as a smile does: a search over one length a side.

Closest points alone leave the corners of a smile where they were at rest, and the crease beyond them
cannot be followed; so pulled models are tried, and chosen by what a coarse fit makes of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.fitting.harmonic import harmonic_weight
from scan2albedo.geometry.operators import laplacian

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SIDES = ((48, 60, 0), (54, 64, 16))
"""iBUG-68 indices: outer and inner corner of the mouth, and the ear that a smile pulls them to."""
STILL = tuple(range(48))
"""Jaw line, brows, nose and eyes."""
PULLS_MM = (0.0, 10.0)
MIN_GAIN = 0.1
"""A pull is chosen when its coarse fit lies at least this part nearer than that of the corner at rest.

Measured: 12 to 20 % on smiles, at most 4 % on faces at rest and open mouths.
"""
JUDGE_WEIGHT = 0.25
"""Samples that follow the corners by at least this much judge them."""


@dataclass(frozen=True)
class MouthCorners:
    """Displacement (C, 3) of the control points per mm of pull, of the right and of the left corner."""

    right: FloatArray
    left: FloatArray

    @classmethod
    def of(cls, model: AnnotatedFaceModel, control_points: FloatArray) -> MouthCorners | None:
        """Return the pulls of an annotated model at `control_points`; None without landmarks."""
        landmarks = model.landmarks_of(control_points)
        if landmarks is None or model.landmark_points is None:
            return None
        corners = model.control_faces[model.landmark_points.face]
        still, right, left = np.zeros((3, len(control_points)), bool)
        still[corners[list(STILL)]] = True
        for mask, (outer, inner, _) in zip((right, left), SIDES, strict=True):
            mask[corners[[outer, inner]]] = True
        matrix = laplacian(control_points, model.control_faces)
        fields = []
        for moving, other, (outer, _, ear) in zip((right, left), (left, right), SIDES, strict=True):
            weight = harmonic_weight(matrix, moving | still | other, moving)
            way = landmarks[ear] - landmarks[outer]
            fields.append(weight[:, None] * way / np.linalg.norm(way))
        return cls(*fields)

    def pulled(self, control_points: FloatArray, right_mm: float, left_mm: float) -> FloatArray:
        """Return the control points (C, 3) with the corners pulled."""
        return control_points + right_mm * self.right + left_mm * self.left

    def sides(self, samples: sparse.csr_matrix) -> tuple[BoolArray, BoolArray]:
        """Return which samples (N, C) of the surface judge the right and the left corner: (N,) each."""
        size = np.linalg.norm(samples @ (self.right + self.left), axis=1)
        right, left = (np.linalg.norm(samples @ field, axis=1) for field in (self.right, self.left))
        return (size > JUDGE_WEIGHT) & (right >= left), (size > JUDGE_WEIGHT) & (right < left)

    def chosen(
        self, control_points: FloatArray, costs_right: list[float], costs_left: list[float]
    ) -> FloatArray:
        """Return the control points pulled by those of PULLS_MM whose costs say so, each side for itself."""
        return self.pulled(control_points, _best(costs_right), _best(costs_left))


def _best(costs: list[float]) -> float:
    best = int(np.argmin(costs))
    return PULLS_MM[best] if costs[best] < (1 - MIN_GAIN) * costs[0] else 0.0
