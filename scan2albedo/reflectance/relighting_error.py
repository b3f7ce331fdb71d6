"""How well a fit predicts pictures that it has not used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.point_light_lobes import point_light_radiance
from scan2albedo.reflectance.robust_fit import ReflectanceFitOptions
from scan2albedo.reflectance.vertex_fit import ReflectanceFit, fit_reflectance
from scan2albedo.reflectance.vertex_samples import VertexSamples

_BLACK = 1e-30
"""Mean square below which light is rounding."""


@dataclass(frozen=True)
class RelightingError:
    """Error over the observations of pictures left out of a fit, all channels together."""

    relative_rmse: float
    """Root mean square of observed minus predicted radiance, over that of the observed."""
    psnr_db: float
    """Of displayed values, radiance^(1 / gamma) with the 99th percentile of the observed as white."""
    noise_part: float
    """The part of `relative_rmse` that the observations' own sigma explains."""
    of_picture: FloatArray
    """(J,): relative RMSE of each picture; NaN where it was not left out or shows no known vertex."""
    observations: int
    """Their number."""
    fit: ReflectanceFit
    """Of the other pictures."""


def relighting_error(
    samples: VertexSamples,
    held_out: ArrayLike,
    *,
    options: ReflectanceFitOptions = ReflectanceFitOptions(),
    gamma: float = 1.2,
) -> RelightingError:
    """Return how well a fit to the pictures that are not `held_out` predicts those that are.

    Parameters
    ----------
    samples : VertexSamples
        J pictures.
    held_out : (J,) array_like of bool
        At least one, and not all.
    options : ReflectanceFitOptions
        With light gains, a flash that lit none of the others has gain 1.
    gamma : float
        Of the display.

    Raises
    ------
    ReflectanceError
        When nothing is left to fit, or nothing to predict.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> lobes = rng.random((8, 20, 4))
    >>> observed = 0.4 * lobes[..., :1] + 0.1 * lobes[..., 1:].sum(-1, keepdims=True) * np.ones(3)
    >>> every = np.ones(observed.shape, bool)
    >>> samples = VertexSamples(observed, np.full(observed.shape, 1e-6), every, lobes, np.arange(8))
    >>> bool(relighting_error(samples, np.arange(8) < 2).relative_rmse < 1e-4)
    True
    """
    left_out = np.asarray(held_out)
    if left_out.dtype != np.bool_ or left_out.shape != samples.light.shape:
        raise ReflectanceError(
            f"held_out is {left_out.dtype} {left_out.shape}, expected bool {samples.light.shape}"
        )
    if not 0 < left_out.sum() < len(left_out):
        raise ReflectanceError(
            f"{left_out.sum()} of {len(left_out)} pictures are held out: neither none nor all"
        )
    fit = fit_reflectance(samples.of_pairs(~left_out), options=options)
    unseen = samples.of_pairs(left_out)
    predicted = _gains(fit, unseen.light) * point_light_radiance(
        fit.reflectance, unseen.turned_lobes(fit.tilt)
    )
    seen = unseen.valid & fit.reflectance.known[:, None]
    if not seen.any():
        raise ReflectanceError("the pictures held out show no vertex that the others do: hold out others")
    of_picture = np.full(len(left_out), np.nan)
    of_picture[left_out] = [
        _relative(unseen.observed_linear[j][seen[j]], predicted[j][seen[j]]) if seen[j].any() else np.nan
        for j in range(len(seen))
    ]
    observed = unseen.observed_linear[seen]
    if not float(np.mean(observed**2)) > _BLACK:
        raise ReflectanceError(
            "the pictures held out are black where the face is: there is nothing to predict"
        )
    return RelightingError(
        _relative(observed, predicted[seen]),
        _psnr(observed, predicted[seen], gamma),
        float(np.sqrt(np.mean(unseen.sigma[seen] ** 2) / _power(observed))),
        of_picture,
        int(seen.sum()),
        fit,
    )


def _gains(fit: ReflectanceFit, light: IntArray) -> FloatArray:
    """Return (J, 1, 3) the gain of each picture's flash, 1 where there is none."""
    known = np.ones((int(light.max()) + 1, 3))
    count = min(len(known), len(fit.light_gain))
    known[:count] = np.where(np.isfinite(fit.light_gain[:count]), fit.light_gain[:count], 1.0)
    return known[light][:, None]


def _power(observed: FloatArray) -> float:
    return max(float(np.mean(observed**2)), np.finfo(float).tiny)


def _relative(observed: FloatArray, predicted: FloatArray) -> float:
    return float(np.sqrt(np.mean((observed - predicted) ** 2) / _power(observed)))


def _psnr(observed: FloatArray, predicted: FloatArray, gamma: float) -> float:
    white = max(float(np.percentile(observed, 99)), np.finfo(float).tiny)
    shown, other = _displayed(observed / white, gamma), _displayed(predicted / white, gamma)
    return float(-10 * np.log10(max(float(np.mean((shown - other) ** 2)), 1e-30)))


def _displayed(linear: FloatArray, gamma: float) -> FloatArray:
    return np.asarray(np.clip(linear, 0, 1) ** (1 / gamma), np.float64)
