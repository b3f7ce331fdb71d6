"""Real spherical harmonics of order 2: nine smooth functions of the normal, 27 parameters for RGB."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

COEFFICIENTS = 9

DIFFUSE_FACTORS = np.repeat([1.0, 2 / 3, 1 / 4], [1, 3, 5])
"""Response of a Lambertian surface to each harmonic of distant light (A_l / pi)."""


def spherical_harmonics_basis(normal: ArrayLike) -> NDArray[np.float64]:
    """Return the nine real harmonics Y_00 ... Y_22 of unit vectors.

    Parameters
    ----------
    normal : (..., 3) array_like of float

    Returns
    -------
    (..., 9) float64, orthonormal over the sphere.

    References
    ----------
    .. [1] R. Ramamoorthi, P. Hanrahan, "An efficient representation for irradiance environment maps",
       SIGGRAPH 2001, eq. 3.

    Examples
    --------
    >>> spherical_harmonics_basis([0.0, 0.0, 1.0]).round(3).tolist()
    [0.282, 0.0, 0.489, 0.0, 0.0, 0.0, 0.631, 0.0, 0.0]
    """
    x, y, z = np.moveaxis(np.asarray(normal, np.float64), -1, 0)
    return np.stack(
        [
            np.full_like(x, 0.5 / np.sqrt(np.pi)),
            np.sqrt(0.75 / np.pi) * y,
            np.sqrt(0.75 / np.pi) * z,
            np.sqrt(0.75 / np.pi) * x,
            np.sqrt(3.75 / np.pi) * x * y,
            np.sqrt(3.75 / np.pi) * y * z,
            np.sqrt(0.3125 / np.pi) * (3 * z * z - 1),
            np.sqrt(3.75 / np.pi) * x * z,
            np.sqrt(0.9375 / np.pi) * (x * x - y * y),
        ],
        -1,
    )


def spherical_harmonics_shading(normal: ArrayLike, coefficients: ArrayLike) -> NDArray[np.float64]:
    """Return the shading sum_k c_k Y_k(n) of normals (..., 3) for coefficients (9,) or (9, 3).

    Parameters
    ----------
    normal : (..., 3) array_like of float
    coefficients : (9,) or (9, C) array_like of float
        Of the shading itself (the diffuse response `DIFFUSE_FACTORS` already applied).

    Returns
    -------
    (...,) or (..., C) float64.
    """
    return spherical_harmonics_basis(normal) @ np.asarray(coefficients, np.float64)
