"""sRGB and linear light (IEC 61966-2-1), exact piecewise curves."""

from typing import cast

import numpy as np

from scan2albedo.core.arrays import ArrayLike, ByteArray, Float32Array, FloatArray, NDArray


def srgb_to_linear(srgb: ArrayLike) -> FloatArray:
    """Decode sRGB values in [0, 1]: c / 12.92 up to 0.04045, ((c + 0.055) / 1.055)^2.4 above.

    Negative values are mirrored, so the curve is odd and defined everywhere.

    >>> srgb_to_linear([0.0, 0.5, 1.0]).round(4).tolist()
    [0.0, 0.214, 1.0]
    """
    value = np.asarray(srgb, float)
    size = np.abs(value)
    return np.copysign(np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4), value)


def linear_to_srgb(linear: ArrayLike) -> FloatArray:
    """Encode linear values: 12.92 c up to 0.0031308, 1.055 c^(1/2.4) - 0.055 above."""
    return encoded_srgb(np.asarray(linear, float))


def encoded_srgb(value: NDArray) -> NDArray:
    """Return `linear_to_srgb` of float32 or float64 in the same precision."""
    size = np.abs(value)
    return np.copysign(np.where(size <= 0.0031308, 12.92 * size, 1.055 * size ** (1 / 2.4) - 0.055), value)


def decode_srgb_integers(pixels: ByteArray | NDArray[np.uint16]) -> Float32Array:
    """Return float32 linear values of 8- or 16-bit sRGB samples by table, in row blocks to spare memory."""
    most = np.iinfo(pixels.dtype).max
    table = srgb_to_linear(np.arange(most + 1) / most).astype(np.float32)
    linear = np.empty(pixels.shape, np.float32)
    for row in range(0, len(pixels), 256):
        linear[row : row + 256] = table[pixels[row : row + 256]]
    return linear


def decode_picture(pixels: ByteArray | NDArray[np.uint16]) -> Float32Array:
    """Return linear colour (H, W, 3) of sRGB samples; (H, W, 4) where they have an alpha that varies."""
    linear, alpha = decode_srgb_integers(pixels[..., :3]), pixels[..., 3:]
    if alpha.size == 0 or alpha.min() == alpha.max():
        return linear
    return np.concatenate([linear, alpha / np.float32(np.iinfo(pixels.dtype).max)], axis=-1)


def linear_of_srgb_numbers(colors: NDArray) -> Float32Array:
    """Return linear colours of sRGB integers, or floats up to 1 or 255; NaN and negative are black."""
    if colors.dtype in (np.uint8, np.uint16):
        return decode_srgb_integers(np.asarray(colors))
    values = np.nan_to_num(colors.astype(float)).clip(0)
    return srgb_to_linear(values / 255 if values.max(initial=0) > 1 else values).astype(np.float32)


def encode_srgb_bytes(linear: ArrayLike) -> ByteArray:
    """Return 8-bit sRGB of linear values clipped to [0, 1], rounded to nearest."""
    return cast("ByteArray", encode_srgb_integers(linear, np.uint8))


def encode_srgb_integers(
    linear: ArrayLike, dtype: type, out: NDArray | None = None
) -> ByteArray | NDArray[np.uint16]:
    """Return sRGB of linear values clipped to [0, 1] as uint8 or uint16, in row blocks to spare memory."""
    array = np.asarray(linear)
    encoded = np.empty(array.shape, dtype) if out is None else out
    for row in range(0, len(array), 256):
        block = linear_to_srgb(np.clip(array[row : row + 256], 0, 1))
        encoded[row : row + 256] = np.round(block * np.iinfo(dtype).max)
    return encoded


def is_deep(linear: Float32Array) -> bool:
    """Return whether most of a picture's values (H, W, 3), in green, are none that 8-bit sRGB has."""
    green = linear[:: max(len(linear) // 256, 1), :, 1]
    return bool(np.mean(decode_srgb_integers(encode_srgb_bytes(green)) != green) > 0.5)


def label_colors() -> ByteArray:
    """Return (11, 3) sRGB colours of labels: 0 black, the others those of matplotlib's tab10."""
    return hex_colors("000000 1f77b4 ff7f0e 2ca02c d62728 9467bd 8c564b e377c2 7f7f7f bcbd22 17becf")


def hex_colors(text: str) -> ByteArray:
    """Return (N, 3) sRGB bytes of colours in hexadecimal digits, as in "1f77b4 ff7f0e"."""
    return np.frombuffer(bytes.fromhex(text), np.uint8).reshape(-1, 3)
