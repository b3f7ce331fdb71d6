"""What others do about light in a photograph: filters, and spherical harmonics, as their authors give them.

All take and return values (H, W) of a chart or picture; scale is unknown to all of them.
"""

import numpy as np

from bench.judging import robust_light
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.lighting.harmonics import harmonics

DARKEST = 1 / 255
"""Of white: below it, logarithms show the camera's noise."""

RETINEX_SCALES = (15 / 512, 80 / 512, 250 / 512)
"""Standard deviations of the Gaussians, in sides of the image."""


def multi_scale_retinex(image: FloatArray, mask: BoolArray) -> FloatArray:
    """Return exp of log image - log(Gaussian * image), averaged over scales: about 1, 0 outside the mask.

    Parameters
    ----------
    image : (H, W) float64
        Linear, white = 1.
    mask : (H, W) bool
        Pixels that count; the Gaussians know no others.

    References
    ----------
    Jobson, Rahman, Woodell, "A multiscale retinex for bridging the gap between color images and the human
    observation of scenes", IEEE TIP 6(7), 1997.

    Examples
    --------
    >>> import numpy as np
    >>> flat = np.full((64, 64), 0.5)
    >>> round(float(multi_scale_retinex(flat, flat > 0).max()), 9)
    1.0
    """
    lit = np.maximum(image, DARKEST)
    around = [blurred_inside(lit, mask, scale * max(mask.shape)) for scale in RETINEX_SCALES]
    reflectance = np.log(lit) - np.mean([np.log(np.maximum(a, DARKEST)) for a in around], axis=0)
    return np.where(mask, np.exp(reflectance), 0)


def histogram_equalized(image: FloatArray, mask: BoolArray) -> FloatArray:
    """Return each pixel's share of pixels in the mask that are not brighter, in (0, 1]; 0 outside the mask.

    Parameters
    ----------
    image : (H, W) float64
    mask : (H, W) bool

    References
    ----------
    Gonzalez, Woods, "Digital image processing", section 3.3.

    Examples
    --------
    >>> import numpy as np
    >>> histogram_equalized(np.array([[3.0, 1.0, 9.0, 1.0]]), np.ones((1, 4), bool)).tolist()
    [[0.75, 0.5, 1.0, 0.5]]
    """
    inside = image[mask]
    ascending = np.sort(inside)
    equalized = np.zeros(mask.shape)
    equalized[mask] = np.searchsorted(ascending, inside, side="right") / max(len(inside), 1)
    return equalized


def blurred_inside(values: FloatArray, mask: BoolArray, deviation: float) -> FloatArray:
    """Return values (H, W) convolved with a Gaussian of `deviation` pixels, averaged over the mask alone."""
    from scipy.ndimage import gaussian_filter

    inside = mask.astype(float)
    total = gaussian_filter(inside, deviation, mode="constant")
    blurred = gaussian_filter(values * inside, deviation, mode="constant")
    return np.asarray(blurred / np.maximum(total, 1e-9))


def homomorphic(value: FloatArray, mask: BoolArray) -> FloatArray:
    """Take the low frequencies out of log V: a Gaussian of an eighth of the image's side.

    References
    ----------
    .. [1] A. Oppenheim, R. Schafer, T. Stockham, "Nonlinear Filtering of Multiplied and Convolved Signals",
       Proceedings of the IEEE 56(8), 1968.
    """
    log = np.log(np.maximum(value, DARKEST))
    return np.where(mask, np.exp(log - blurred_inside(log, mask, max(mask.shape) / 8)), 0)


def robust_harmonics(value: FloatArray, normal: FloatArray, mask: BoolArray) -> FloatArray:
    """Divide by nine spherical harmonics of the normal, fitted with L1 (iteratively reweighted).

    References
    ----------
    .. [1] R. Basri, D. Jacobs, "Lambertian Reflectance and Linear Subspaces", PAMI 25(2), 2003.
    """
    albedo = np.zeros(mask.shape)
    albedo[mask] = value[mask] / robust_light(harmonics(normal[mask], 2), value[mask])
    return albedo
