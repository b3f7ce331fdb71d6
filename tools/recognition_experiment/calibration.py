"""The calibration of similarities by albedo and by shape that pairs of known people ask for."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.recognition import Calibration


def calibrated(albedo: ArrayLike, shape: ArrayLike, genuine: ArrayLike) -> Calibration:
    """Return the calibration by similarities (N,) of pairs, `genuine` (N,) where a pair shows one person.

    ValueError when there are fewer than three pairs of one person, or of two.
    """
    scores = np.stack([np.ravel(albedo), np.ravel(shape)]).astype(np.float64)
    same = np.ravel(np.asarray(genuine, bool))
    if min(same.sum(), (~same).sum()) < 3:
        raise ValueError(f"{same.sum()} pairs of one person and {(~same).sum()} of two, expected 3 or more")
    (a, b), (c, d) = _discriminant(scores[:1], same), _discriminant(scores[1:], same)
    first, second, offset = _discriminant(scores, same)
    return Calibration((a, b), (c, d), (first, second, offset))


def _discriminant(scores: FloatArray, same: BoolArray) -> tuple[float, ...]:
    """Return slopes and offset for scores (K, N); pairs of one person weigh as much as those of two."""
    means = [scores[:, chosen].mean(1) for chosen in (same, ~same)]
    spread = np.mean([np.atleast_2d(np.cov(scores[:, chosen])) for chosen in (same, ~same)], axis=0)
    slope = np.linalg.solve(spread, means[0] - means[1])
    return (*map(float, slope), float(-slope @ (means[0] + means[1]) / 2))
