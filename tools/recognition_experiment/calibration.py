"""The calibration of similarities by several kinds that pairs of known people ask for."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.recognition import Calibration
from scan2albedo.recognition.templates import Kind


def calibrated(similarities: Mapping[Kind, ArrayLike], genuine: ArrayLike) -> Calibration:
    """Return the calibration by similarities (N,) of pairs, `genuine` (N,) where a pair shows one person.

    Pairs of one person weigh as much as those of two. ValueError when there are fewer than three of either.
    """
    scores = np.stack([np.ravel(values) for values in similarities.values()]).astype(np.float64)
    same = np.ravel(np.asarray(genuine, bool))
    if min(same.sum(), (~same).sum()) < 3:
        raise ValueError(f"{same.sum()} pairs of one person and {(~same).sum()} of two, expected 3 or more")
    own, other = (tuple(scores[:, chosen].mean(1).tolist()) for chosen in (same, ~same))
    spread = np.mean([np.atleast_2d(np.cov(scores[:, chosen])) for chosen in (same, ~same)], axis=0)
    return Calibration(tuple(similarities), own, other, tuple(map(tuple, spread.tolist())))
