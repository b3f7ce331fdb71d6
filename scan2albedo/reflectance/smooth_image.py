"""An image with gaps, smoothed and looked up with its gradient."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import ReflectanceError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_LEAST_WEIGHT = 1e-6
"""Of valid pixels around a gap, below which it is not filled."""


class SmoothImage:
    """A linear image, smoothed by a Gaussian over its valid pixels only, between pixels bilinear.

    Parameters
    ----------
    image_linear : (H, W, 3) array_like of float
        NaN and infinite pixels are gaps.
    mask : (H, W) array_like of bool or None
        False where the image shows something else.
    blur_px : float
        Standard deviation of the Gaussian; 0 for none.

    Raises
    ------
    ReflectanceError
        When no pixel is left.
    ValueError
        When shapes are others.
    """

    def __init__(self, image_linear: ArrayLike, mask: ArrayLike | None, blur_px: float) -> None:
        from scipy.ndimage import gaussian_filter

        image, self.valid = _checked(image_linear, mask)
        filled = np.where(self.valid[..., None], image, 0.0)
        if blur_px > 0:
            weight = gaussian_filter(self.valid.astype(np.float64), blur_px, mode="constant")
            blurred = gaussian_filter(filled, (blur_px, blur_px, 0), mode="constant")
            enough = weight > _LEAST_WEIGHT
            filled = np.where(enough[..., None], blurred / np.where(enough, weight, 1.0)[..., None], 0.0)
        self._image = filled

    def covers(self, pixels: FloatArray) -> BoolArray:
        """Return (N,) whether all four pixels around each of (N, 2) are valid; NaN is outside."""
        height, width = self.valid.shape
        x, y = pixels[:, 0], pixels[:, 1]
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        left, top, _, _ = self._cells(np.where(inside[:, None], pixels, 0.0))
        around = self.valid[top, left] & self.valid[top + 1, left]
        around &= self.valid[top, left + 1] & self.valid[top + 1, left + 1]
        return np.asarray(inside & around, np.bool_)

    def look_up(self, pixels: FloatArray) -> FloatArray:
        """Return colours (N, 3) at pixels (N, 2); beyond the border the border's."""
        left, top, fx, fy = self._cells(pixels)
        above = (1 - fx) * self._image[top, left] + fx * self._image[top, left + 1]
        below = (1 - fx) * self._image[top + 1, left] + fx * self._image[top + 1, left + 1]
        return np.asarray((1 - fy) * above + fy * below)

    def gradient(self, pixels: FloatArray) -> FloatArray:
        """Return the derivatives (N, 3, 2) of `look_up` by column and row; 0 beyond the border."""
        left, top, fx, fy = self._cells(pixels)
        a, b = self._image[top, left], self._image[top, left + 1]
        c, d = self._image[top + 1, left], self._image[top + 1, left + 1]
        slopes = np.stack([(1 - fy) * (b - a) + fy * (d - c), (1 - fx) * (c - a) + fx * (d - b)], 2)
        height, width = self.valid.shape
        inside = (pixels > 0) & (pixels < [width - 1, height - 1])
        return np.asarray(slopes * inside[:, None, :])

    def _cells(
        self, pixels: FloatArray
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, FloatArray]:
        """Return column and row of the upper left pixel, and the way from it (N, 1)."""
        height, width = self.valid.shape
        x, y = np.clip(pixels[:, 0], 0, width - 1), np.clip(pixels[:, 1], 0, height - 1)
        left = np.minimum(x.astype(np.int64), width - 2)
        top = np.minimum(y.astype(np.int64), height - 2)
        return left, top, (x - left)[:, None], (y - top)[:, None]


def _checked(image_linear: ArrayLike, mask: ArrayLike | None) -> tuple[FloatArray, BoolArray]:
    image = np.asarray(image_linear, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 2:
        raise ValueError(f"image_linear must have shape (H, W, 3), H and W at least 2, got {image.shape}")
    valid = np.asarray(np.isfinite(image).all(2))
    if mask is not None:
        chosen = np.asarray(mask)
        if chosen.dtype != np.bool_ or chosen.shape != valid.shape:
            raise ValueError(f"mask must be bool {valid.shape}, got {chosen.dtype} {chosen.shape}")
        valid = np.asarray(valid & chosen, np.bool_)
    if not valid.any():
        raise ReflectanceError("the image has no pixel left: all are NaN or masked; check the mask")
    return image, valid
