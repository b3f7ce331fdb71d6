"""How much of each harmonic of distant light the diffuse lobe and the Blinn-Phong lobes let through."""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from scan2albedo.core.arrays import FloatArray

Lobe = Literal["tilted", "full"]
"""`tilted`: the true lobe of each view, averaged around its mean direction. `full`, as Han, Wang and Xu
have it: the lobe of v = n over the whole sphere, turned to the mirrored view."""

ORDER = 8
_VIEWS = 33
_QUADRATURE = (96, 192)


def lambert_coefficients(order: int = ORDER) -> FloatArray:
    """Return (order + 1,) responses A_l / pi of a Lambertian surface (Ramamoorthi and Hanrahan, JOSA A 2001).

        A_l / pi = 2 integral over 0 ... 1 of t P_l(t) dt.

    >>> lambert_coefficients(4).round(6).tolist()
    [1.0, 0.666667, 0.25, 0.0, -0.041667]
    """
    response = np.zeros(order + 1)
    response[:2] = [1.0, 2 / 3][: order + 1]
    value = 1 / 4
    for degree in range(2, order + 1, 2):
        response[degree] = value
        value *= -(degree - 1) / (degree + 4)
    return response


def lobe_coefficients(exponent: float, order: int = ORDER) -> FloatArray:
    """Return (order + 1,) coefficients B_l of a Blinn-Phong lobe with the exponent s, seen along the normal.

    With v = n the half vector halves the angle, and over the full sphere with a = s / 2

        B_l = (s + 2) / 4 integral of ((1 + t) / 2)^a P_l(t) dt,
        B_0 = 1,   B_{l+1} = B_l (a - l) / (a + l + 2).

    Raises `ValueError` when s is not more than 0.

    >>> lobe_coefficients(8, order=4).round(4).tolist()
    [1.0, 0.6667, 0.2857, 0.0714, 0.0079]
    """
    _check_exponent(exponent)
    half, degree = exponent / 2, np.arange(order)
    return np.concatenate([[1.0], np.cumprod((half - degree) / (half + degree + 2))])


def tilted_lobe(angle_rad: ArrayLike, exponent: float) -> tuple[FloatArray, FloatArray]:
    """Return coefficients (..., 9) of the true lobe, averaged around its mean direction, and that direction.

    Lobes lean from the mirrored view towards the normal, broad ones most: light from below the horizon is
    missing, and n.h falls more slowly that way. The second array is the tilt in rad from n to the mean
    direction, in the plane of n and v away from v; the mirrored view has the tilt `angle_rad`, between n and
    v. From pi / 2 on (a surface that is not seen) coefficients are 0. Raises `ValueError` when the exponent
    is not more than 0 or an angle not finite.

    In generated light the highlights of s = 1, 8 and 64 seen at 60 degrees are 3, 3 and 12 % off; with the
    full lobe 79, 72 and 86 % (tools/bench_reflectance_model.py). The table has 33 views, splines between.

    >>> _, tilt = tilted_lobe(np.radians([0, 60]), 8)
    >>> np.degrees(tilt).round(1).tolist()
    [0.0, 41.8]
    """
    _check_exponent(exponent)
    angle = np.asarray(angle_rad, np.float64)
    if not np.isfinite(angle).all():
        raise ValueError("angle_rad holds NaN or infinite values")
    values = _spline(float(exponent))(np.clip(angle, 0.0, np.pi / 2))
    return np.where(angle[..., None] < np.pi / 2, values[..., :-1], 0.0), values[..., -1]


def tilted_lobe_slopes(angle_rad: ArrayLike, exponent: float) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (..., 9) and (...) of the results of `tilted_lobe` by the angle.

    >>> h = 1e-5
    >>> ahead, behind = tilted_lobe(0.7 + h, 8)[1], tilted_lobe(0.7 - h, 8)[1]
    >>> bool(abs(tilted_lobe_slopes(0.7, 8)[1] - (ahead - behind) / (2 * h)) < 1e-8)
    True
    """
    _check_exponent(exponent)
    angle = np.asarray(angle_rad, np.float64)
    slopes = _spline(float(exponent))(np.clip(angle, 0.0, np.pi / 2), 1)
    return np.where(angle[..., None] < np.pi / 2, slopes[..., :-1], 0.0), slopes[..., -1]


def _integral(angle: float, exponent: float) -> tuple[FloatArray, float]:
    """Return coefficients of the true lobe around its mean direction, and that direction's tilt."""
    heights, turns = _QUADRATURE
    nodes, weights = leggauss(heights)
    t, across = (nodes + 1) / 2, np.sqrt(1 - ((nodes + 1) / 2) ** 2)
    # The lobe is even in the turn, so half a circle of midpoints covers all of it.
    forward = -across[:, None] * np.cos((np.arange(turns) + 0.5) * np.pi / turns)
    upward = np.broadcast_to(t[:, None], forward.shape)
    light_view = np.cos(angle) * upward - np.sin(angle) * forward
    normal_half = (upward + np.cos(angle)) / np.sqrt(2 + 2 * light_view)
    kernel = (exponent + 2) / (8 * np.pi) * normal_half**exponent
    kernel *= (weights / 2)[:, None] * 2 * np.pi / turns
    tilt = float(np.arctan2(np.sum(kernel * forward), np.sum(kernel * upward)))
    toward = np.clip(np.cos(tilt) * upward + np.sin(tilt) * forward, -1, 1)
    return np.einsum("tp,tpl->l", kernel, legvander(toward, ORDER)), tilt


@cache
def _spline(exponent: float) -> CubicSpline:
    """Coefficients around the mean direction, and its tilt, by the angle between n and v."""
    angles = np.linspace(0, np.pi / 2, _VIEWS)
    found = [_integral(float(a), exponent) for a in angles]
    found[0] = found[0][0], 0.0
    return CubicSpline(angles, np.stack([np.append(values, tilt) for values, tilt in found]))


def _check_exponent(exponent: float) -> None:
    if not exponent > 0:
        raise ValueError(f"exponent must be more than 0, got {exponent}")
