"""How sure the landmarks of a fit are."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray

_NEAR_MM = 12.0
"""The surface around a landmark that shows it: about an eye's height."""
_UNSEEN_MM = 4.0
"""Deviation, along an axis, of a point around which there is no scan."""
_FEATURES_MM = {
    (0, 1): 8.0,
    (1, 16): 4.2,
    (16, 17): 8.0,
    (17, 27): 2.2,
    (27, 31): 1.9,
    (31, 36): 1.1,
    (36, 48): 2.0,
    (48, 68): 2.1,
}
"""Deviation in mm along an axis by iBUG-68 numbers (begin, end): what `tools/bench_landmarks.py
--expressions` found on its faces. No others have judged it."""


def landmark_deviation_mm(landmarks: FloatArray, vertices: FloatArray, residual_mm: FloatArray) -> FloatArray:
    """Return (68,) standard deviations along each axis of `landmarks` (68, 3), in mm.

    What is usual for the feature, more where the fitted surface, `vertices` (V, 3), has no scan near it
    (`residual_mm` (V,) NaN), or lies off it.
    """
    usual = np.zeros(len(landmarks))
    for (begin, end), deviation_mm in _FEATURES_MM.items():
        usual[begin:end] = deviation_mm
    near = cKDTree(vertices).query_ball_point(landmarks, _NEAR_MM)
    unseen, off = np.ones(len(landmarks)), np.zeros(len(landmarks))
    for number, index in enumerate(near):
        if index:
            seen = residual_mm[index][~np.isnan(residual_mm[index])]
            unseen[number] = 1 - len(seen) / len(index)
            off[number] = seen.mean() if len(seen) else 0.0
    return np.sqrt(usual**2 + (_UNSEEN_MM * unseen) ** 2 + off**2)
