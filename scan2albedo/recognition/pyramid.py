"""Complex steerable pyramids: all scales by pyrtools, and the coarsest alone by its cached filters."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import needs_extra

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class SteerablePyramid:
    """A complex steerable pyramid of one image."""

    bands: tuple[ComplexArray, ...]
    """Finest scale first; each scale has half the sides of the one before."""
    low_pass: FloatArray
    high_pass: FloatArray
    """`low_pass`, `high_pass`: (h, w): what is left below the coarsest and above the finest scale."""
    _source: Any

    def reconstructed(self) -> FloatArray:
        """Return the image (H, W) that the pyramid holds."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # discarded imaginary parts
            return np.asarray(self._source.recon_pyr(), np.float64)


def steerable_pyramid(image: FloatArray, *, scales: int = 3, orientations: int = 10) -> SteerablePyramid:
    """Return the complex steerable pyramid of an image; its filters wrap around the image's edges.

    After Simoncelli, Freeman, ICIP 1995, and, complex, Portilla, Simoncelli, IJCV 40, 2000.

    Parameters
    ----------
    image : (H, W) float64
        Sides even at every scale, and of 2^(scales + 2) pixels or more.
    scales, orientations : int

    Raises
    ------
    ValueError
        When the image does not allow that many scales.
    """
    image = np.asarray(image, np.float64)
    if image.ndim != 2 or min(image.shape) < 2 ** (scales + 2) or any(n % 2**scales for n in image.shape):
        raise ValueError(
            f"image has shape {image.shape}, expected (H, W) of multiples of {2**scales}, "
            f"{2 ** (scales + 2)} or more, for {scales} scales"
        )
    with needs_extra("recognition"):
        from pyrtools.pyramids import SteerablePyramidFreq

    source = SteerablePyramidFreq(image, height=scales, order=orientations - 1, is_complex=True)
    bands = tuple(
        np.stack([source.pyr_coeffs[(scale, k)] for k in range(orientations)]) for scale in range(scales)
    )
    return SteerablePyramid(
        bands, source.pyr_coeffs["residual_lowpass"], source.pyr_coeffs["residual_highpass"], source
    )


def coarsest_bands(image: FloatArray, *, scales: int = 3, orientations: int = 10) -> ComplexArray:
    """Return `steerable_pyramid(image).bands[-1]` (O, H / s, W / s), s = 2^(scales - 1), without the rest.

    A band is the inverse transform of X_k H_k over the low frequencies k that its size can hold, with the
    image's transform X and a filter H that is read off the pyramid of a point once for each size. ValueError
    as `steerable_pyramid`.
    """
    filters = _coarsest_filters(image.shape, scales, orientations)
    rows, columns = (np.fft.fftfreq(n, 1 / n).astype(int) for n in filters.shape[1:])
    spectrum = fft.fft2(image)[np.ix_(rows, columns)]
    return np.asarray(fft.ifft2(spectrum * filters), np.complex128)


@lru_cache(maxsize=8)
def _coarsest_filters(shape: tuple[int, int], scales: int, orientations: int) -> ComplexArray:
    point = np.zeros(shape)
    point[0, 0] = 1.0
    filters = fft.fft2(steerable_pyramid(point, scales=scales, orientations=orientations).bands[-1])
    filters.setflags(write=False)
    return filters
