"""The pyramid's input from an albedo: one channel, averaged down, filled outside its mask, mirrored."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.options import Channel

_DARKEST = 1 / 255
"""Of the brightest value: below it a ratio of channels is noise."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


class NothingToCompareError(RecognitionError):
    """An image without a single coefficient: masked (nearly) everywhere, or black."""


def checked_image(
    image: ArrayLike, mask: ArrayLike | None, channel: Channel, what: str
) -> tuple[FloatArray, BoolArray]:
    """Return one channel (H, W), 0 outside the mask, and the mask (H, W); errors name `what`."""
    pixels = np.asarray(image, np.float64)
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3) or pixels.size == 0:
        raise ValueError(f"{what} has shape {pixels.shape}, expected (H, W) or (H, W, 3)")
    valid = np.ones(pixels.shape[:2], bool) if mask is None else np.asarray(mask)
    if valid.shape != pixels.shape[:2]:
        raise RecognitionError(
            f"{what} has {_size(pixels)} pixels, its mask {_size(valid)}; give a mask of the image's size"
        )
    if valid.dtype != np.bool_:
        raise ValueError(f"{what}: its mask is of {valid.dtype}, expected bool")
    if not valid.any():
        raise NothingToCompareError(
            f"{what} is masked everywhere; leave it out, or give a mask with valid pixels"
        )
    if not np.isfinite(pixels[valid]).all():
        bad = int((~np.isfinite(pixels[valid].reshape(valid.sum(), -1)).all(axis=1)).sum())
        raise RecognitionError(
            f"{what}: {bad} of {valid.sum()} pixels in its mask are not finite; take them out of the mask"
        )
    pixels = np.where(valid if pixels.ndim == 2 else valid[..., None], pixels, 0.0)
    return (one_channel(pixels, channel) if pixels.ndim == 3 else pixels), valid


def one_channel(color_linear: FloatArray, channel: Channel) -> FloatArray:
    """Return one channel (H, W), see `TemplateOptions.channel`, of linear colour (H, W, 3)."""
    if channel == "value":
        return np.asarray(color_linear.max(axis=2))
    if channel == "luminance":
        return np.asarray(color_linear @ _LUMINANCE)
    lit = np.maximum(color_linear[..., :2], _DARKEST * max(float(color_linear.max()), 1e-12))
    return np.asarray(lit[..., 0] / lit[..., 1])


def averaged_down(image: FloatArray, mask: BoolArray, size: int, what: str) -> tuple[FloatArray, BoolArray]:
    """Return image and mask, the longer side at most `size`; a pixel is valid where half of its area is."""
    longest = max(image.shape)
    if longest <= size:
        return image, mask
    height, width = (max(1, round(side * size / longest)) for side in image.shape)
    import cv2

    # The area average of OpenCV holds for factors above 1, the only ones here.
    total = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    share = cv2.resize(mask.astype(np.float64), (width, height), interpolation=cv2.INTER_AREA)
    valid = share >= 0.5
    if not valid.any():
        raise NothingToCompareError(f"{what} has no valid pixel left at {size} pixels a side; widen its mask")
    return np.where(valid, total / np.maximum(share, 0.5), 0.0), valid


def without_holes(mask: BoolArray, radius: float) -> BoolArray:
    """Return the mask (H, W) closed by a disc whose radius is given in sides of the image."""
    reach = round(radius * max(mask.shape))
    if reach == 0 or mask.all():
        return mask
    import cv2

    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = (row**2 + column**2 <= reach**2).astype(np.uint8)
    closed = cv2.morphologyEx(np.pad(mask, reach).astype(np.uint8), cv2.MORPH_CLOSE, disc)
    return np.asarray(closed[reach:-reach, reach:-reach] > 0)


def scaled_to_unit_mean(image: FloatArray, mask: BoolArray, what: str) -> FloatArray:
    """Return the image over its mean in the mask."""
    with np.errstate(over="ignore"):
        mean = float(image[mask].mean())
    if mean == np.inf:
        raise RecognitionError(f"{what} reaches {image[mask].max():.3g}, too much to average; scale it down")
    if not mean > 0:
        raise NothingToCompareError(
            f"{what} has the mean {mean:g} in its mask, expected > 0; leave a black image out, or "
            "compare as it is (unit_mean=False)"
        )
    return image / mean


def mirrored(image: FloatArray, multiple: int) -> FloatArray:
    """Return the image followed by its mirror image on both axes, with sides a multiple of `multiple`.

    The pyramid's filters wrap around, so they meet the image's own edge instead of the opposite one.
    """
    after = [n + -2 * n % multiple for n in image.shape]
    return np.pad(image, [(0, a) for a in after], mode="symmetric")


def carried_mask(mask: BoolArray, step: int) -> BoolArray:
    """Return the mask (ceil(H / step), ceil(W / step)) of coefficients.

    A coefficient lies on pixel `step` times its index; it is valid when all pixels up to `step` / 2 away are.
    """
    if step == 1:
        return mask
    from scipy.ndimage import minimum_filter

    return np.asarray(minimum_filter(mask, size=step + 1, mode="nearest")[::step, ::step])


def _size(image: NDArray[np.generic]) -> str:
    return " x ".join(map(str, image.shape[:2]))
