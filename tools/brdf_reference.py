"""Lambert, Oren-Nayar, Minnaert and Phong from cosines: the readable reference of the compiled kernels.

Every function takes the cosines between the unit normal n, the unit direction to the light l and the
unit direction to the viewer v, and returns the factor that multiplies albedo (Phong: specular strength)
and the light's irradiance. All are 0 where the light is behind the surface and finite everywhere.
"""

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray

COSINE_FLOOR = 1e-4
"""Cosines below this count as this where a model divides by them."""


def lambert(n_l: ArrayLike) -> FloatArray:
    """Return the Lambertian factor max(0, n.l).

    References
    ----------
    .. [1] J. H. Lambert, "Photometria", 1760.

    Examples
    --------
    >>> lambert([1.0, 0.5, -0.5]).tolist()
    [1.0, 0.5, 0.0]
    """
    return np.maximum(np.asarray(n_l, float), 0.0)


def oren_nayar(n_l: ArrayLike, n_v: ArrayLike, l_v: ArrayLike, sigma_rad: float) -> FloatArray:
    """Return the Oren-Nayar factor of a rough diffuse surface.

    cos(theta_i) (A + B max(0, cos dphi) sin(alpha) tan(beta)), A = 1 - 0.5 s^2/(s^2 + 0.33),
    B = 0.45 s^2/(s^2 + 0.09), s = sigma. The product of the three angles is written as
    max(0, l.v - (n.l)(n.v)) / max(n.l, n.v), which has no azimuth to be undefined and no tangent
    to blow up.

    Parameters
    ----------
    n_l, n_v, l_v : array_like of float in [-1, 1]
        Cosines; they broadcast.
    sigma_rad : float
        Standard deviation of the facet slopes, >= 0; 0 is Lambert exactly.

    References
    ----------
    .. [1] M. Oren, S. K. Nayar, "Generalization of Lambert's reflectance model", SIGGRAPH 1994, eq. 30.
    """
    cos_i, cos_r = lambert(n_l), lambert(n_v)
    variance = sigma_rad * sigma_rad
    a = 1.0 - 0.5 * variance / (variance + 0.33)
    b = 0.45 * variance / (variance + 0.09)
    s = np.maximum(np.asarray(l_v, float) - cos_i * cos_r, 0.0)
    return cos_i * (a + b * s / np.maximum(np.maximum(cos_i, cos_r), COSINE_FLOOR))


def minnaert(n_l: ArrayLike, n_v: ArrayLike, exponent: float) -> FloatArray:
    """Return Minnaert's factor (n.l)^k (n.v)^(k - 1) for exponent k > 0; k = 1 is Lambert.

    n.v is kept above `COSINE_FLOOR`, so that the limb stays finite for k < 1.

    References
    ----------
    .. [1] M. Minnaert, "The reciprocity principle in lunar photometry", Astrophys. J. 93, 1941.
    """
    cos_i = lambert(n_l)
    cos_r = np.maximum(np.asarray(n_v, float), COSINE_FLOOR)
    return np.where(cos_i > 0, cos_i**exponent * cos_r ** (exponent - 1.0), 0.0)


def phong(n_l: ArrayLike, n_v: ArrayLike, l_v: ArrayLike, exponent: float) -> FloatArray:
    """Return Phong's highlight max(0, r.v)^m with r the mirrored light, r.v = 2 (n.l)(n.v) - l.v.

    0 where the light is behind the surface, and where r points away from the viewer, whatever the
    exponent (an even power of a negative cosine would be a false highlight).

    References
    ----------
    .. [1] B. T. Phong, "Illumination for computer generated pictures", CACM 18(6), 1975.
    """
    n_l = np.asarray(n_l, float)
    r_v = 2.0 * n_l * np.asarray(n_v, float) - np.asarray(l_v, float)
    lit = (n_l > 0) & (r_v > 0)
    return np.where(lit, np.where(lit, np.minimum(r_v, 1.0), 1.0) ** exponent, 0.0)
