"""Robust losses rho(r) and the weights w(r) = rho'(r) / r of the least squares that minimise them [1]_.

Weights are 1 where the residual r is 0, but for Student's t. A scale or a threshold is in the unit of r.

.. [1] P. Holland, R. Welsch, "Robust regression using iteratively reweighted least-squares", Communications
   in Statistics A6(9), 1977.
"""

import numpy as np
from scipy.special import ndtri

from scan2albedo.core.arrays import FloatArray


def normal_deviation(error: FloatArray, axis: int | None = None) -> FloatArray:
    """Return the standard deviation of normal errors that have this median of |error| along an axis."""
    return np.median(np.abs(error), axis) / ndtri(0.75)


def student_t_weights(square: FloatArray, freedom: float, count: int = 1) -> FloatArray:
    """Return (nu + d) / (nu + q) of Student's t [1]_ with nu degrees of `freedom`.

    `square` q, of any shape, is the sum of the squares of `count` d residuals in their scale.

    .. [1] K. Lange, R. Little, J. Taylor, "Robust statistical modeling using the t distribution", JASA 84,
       1989.
    """
    return (freedom + count) / (freedom + square)


def student_t_loss(square: FloatArray, freedom: float, count: int = 1) -> FloatArray:
    """Return (nu + d) / 2 log(1 + q / nu), minus the log density of residuals with `student_t_weights`."""
    return (freedom + count) / 2 * np.log1p(square / freedom)


def cauchy_weights(residual: FloatArray, scale: FloatArray | float) -> FloatArray:
    """Return 1 / (1 + (r / s)^2)."""
    return 1 / (1 + (residual / scale) ** 2)


def geman_mcclure_weights(residual: FloatArray, scale: FloatArray | float) -> FloatArray:
    """Return 1 / (1 + (r / s)^2)^2 [1]_: far outliers hardly count.

    .. [1] S. Geman, D. McClure, "Statistical methods for tomographic image reconstruction", Bulletin of the
       International Statistical Institute 52, 1987.
    """
    return cauchy_weights(residual, scale) ** 2


def huber_weights(residual: FloatArray, threshold: float) -> FloatArray:
    """Return min(1, k / |r|) of Huber's loss with the threshold k."""
    return threshold / np.maximum(np.abs(residual), threshold)


def huber_loss(residual: FloatArray, threshold: float) -> FloatArray:
    """Return r^2 / 2 up to the threshold k, k (|r| - k / 2) beyond [1]_.

    .. [1] P. Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35, 1964.
    """
    size = np.abs(residual)
    return np.where(size > threshold, threshold * (size - threshold / 2), size**2 / 2)


def tukey_weights(residual: FloatArray, scale: FloatArray | float) -> FloatArray:
    """Return (1 - (r / s)^2)^2, Tukey's biweight, and 0 beyond the scale s."""
    return np.maximum(1 - (residual / scale) ** 2, 0) ** 2
