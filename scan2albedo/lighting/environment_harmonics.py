"""Light from everywhere as coefficients of spherical harmonics."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.harmonics import harmonics

FloatArray = NDArray[np.float64]

_NODES = 160
"""Least number of quadrature nodes from pole to pole: degree 8 is then integrated to 1e-7."""


def project_environment(environment_linear: ArrayLike, order: int = 8) -> FloatArray:
    """Return the coefficients of an environment map, its texels constant.

        L_lm = integral over the sphere of L(d) Y_lm(d).

    Parameters
    ----------
    environment_linear : (..., H, W, 3) array_like of float
        Radiance of one map or several; rows from +y down to -y, columns by azimuth from -pi to pi, from +z
        toward +x.
    order : int
        Highest degree.

    Returns
    -------
    (..., (order + 1)^2, 3) float64, in the order of `harmonics`; light of 1 gives sqrt(4 pi), 0, 0, ...

    Raises
    ------
    ValueError
        When the map has another shape, is empty or not finite.

    Examples
    --------
    >>> abs(project_environment(np.ones((2, 4, 3)), order=1)[:, 0]).round(6).tolist()
    [3.544908, 0.0, 0.0, 0.0]
    """
    image = np.asarray(environment_linear, np.float64)
    if image.ndim < 3 or image.shape[-1] != 3 or image.size == 0:
        raise ValueError(f"environment_linear must have shape (..., H, W, 3), got {image.shape}")
    if not np.isfinite(image).all():
        raise ValueError("environment_linear must be finite")
    height, width = image.shape[-3:-1]
    coefficients = np.zeros((*image.shape[:-3], (order + 1) ** 2, 3))
    for row in range(height):
        coefficients += row_projection(row, (height, width), order).T @ image[..., row, :, :]
    return coefficients


def row_projection(row: int, shape: tuple[int, int], order: int = 8) -> FloatArray:
    """Return (W, (order + 1)^2) integrals of the harmonics over the texels of a row of maps (H, W)."""
    height, width = shape
    down, down_weight = _nodes(max(2, -(-_NODES // height)))
    across, across_weight = _nodes(max(2, -(-2 * _NODES // width)))
    polar = (row + down) * np.pi / height
    azimuth = ((np.arange(width)[:, None] + across) / width - 0.5) * 2 * np.pi
    values = harmonics(map_directions(polar[:, None, None], azimuth), order)
    share = down_weight * np.sin(polar) * np.pi / height
    return np.einsum("a,c,awcb->wb", share, across_weight * 2 * np.pi / width, values, optimize=True)


def map_directions(polar_rad: ArrayLike, azimuth_rad: ArrayLike) -> FloatArray:
    """Return (..., 3) unit vectors of angles from +y down, and from +z toward +x."""
    polar, azimuth = np.broadcast_arrays(
        np.asarray(polar_rad, np.float64), np.asarray(azimuth_rad, np.float64)
    )
    across = np.sin(polar)
    return np.stack([across * np.sin(azimuth), np.cos(polar), across * np.cos(azimuth)], -1)


def project_distant_lights(lights: DistantLights, order: int = 8) -> FloatArray:
    """Return ((order + 1)^2, 3) coefficients of distant lights: sum of irradiance times Y(direction).

    Examples
    --------
    >>> project_distant_lights(DistantLights([[0, 1, 0]], [[1, 0, 0]]), order=1)[:, 0].round(3).tolist()
    [0.282, 0.489, 0.0, 0.0]
    """
    directions = np.asarray(lights.directions, np.float64)
    return harmonics(directions, order).T @ np.asarray(lights.irradiance_linear, np.float64)


def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre nodes and weights on 0 ... 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2
