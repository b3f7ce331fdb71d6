"""How far an albedo is from the truth, up to one scale, which no image contains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class AlbedoError:
    """`mse_percent` = 100 mean((a A - A_true)^2), `relative_rmse` = ||a A - A_true|| / ||A_true||."""

    mse_percent: float
    relative_rmse: float


def albedo_error(estimate: ArrayLike, truth: ArrayLike, mask: ArrayLike) -> AlbedoError:
    """Return the error of an albedo with the single best global scale a.

    a = sum(A A_true) / sum(A^2): light strength and albedo cannot be separated. ValueError for shapes that
    disagree, an empty mask, or values that are not finite inside it.

    Parameters
    ----------
    estimate, truth, mask : array_like
        Linear albedo, (H, W, C) or (H, W) of float; and the texels compared, (H, W) of bool.

    >>> albedo_error([[0.2, 0.4]], [[0.1, 0.2]], [[True, True]]).mse_percent
    0.0
    """
    ours, true, chosen = np.asarray(estimate, float), np.asarray(truth, float), np.asarray(mask, bool)
    if ours.shape != true.shape or ours.shape[: chosen.ndim] != chosen.shape or not chosen.any():
        shapes = f"estimate {ours.shape}, truth {true.shape} and mask {chosen.shape}"
        raise ValueError(f"{shapes} ({int(chosen.sum())} texels) must agree and not be empty")
    ours, true = ours[chosen], true[chosen]
    if not (np.isfinite(ours).all() and np.isfinite(true).all()):
        raise ValueError("estimate or truth holds NaN or infinite values inside the mask")
    square = float(np.sum(ours * ours))
    scale = float(np.sum(ours * true)) / square if square > 0 else 0.0
    difference = scale * ours - true
    norm, rmse = (float(np.sqrt(np.sum(values**2))) for values in (true, difference))
    return AlbedoError(100 * float(np.mean(difference**2)), rmse / norm if norm > 0 else float(rmse > 0))
