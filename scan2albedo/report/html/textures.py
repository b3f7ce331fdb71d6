"""Pictures inside the page: textures for the viewer, and what is shown as it is."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.report.html.mesh_data import encoded

FloatArray = NDArray[np.float64]

_BRIGHT_PERCENTILE = 99.9
"""What is brighter than this is clipped in the 8 bits of a texture."""


@dataclass(frozen=True)
class TextureStyle:
    """How textures are stored: longest side in texels, and a JPEG's quality or None for PNG without loss."""

    size: int
    quality: int | None


def texture_entry(
    linear: NDArray[np.floating], mask: NDArray[np.bool_], style: TextureStyle, *, factor: float | None = None
) -> dict[str, Any]:
    """Return a linear texture as 8-bit sRGB for the viewer, carried on beyond the mask.

    Parameters
    ----------
    linear : (H, W, 3) float
    mask : (H, W) bool
    style : TextureStyle
    factor : float, optional
        By which it is multiplied before it is encoded; when omitted the one that uses the 8 bits well. The
        viewer divides by it.
    """
    from scan2albedo.applications.pictures import padded

    if factor is None:
        bright = float(np.percentile(linear[mask].max(-1), _BRIGHT_PERCENTILE)) if mask.any() else 0.0
        factor = 1 / bright if bright > 0 else 1.0
    pixels = encode_srgb_bytes(np.clip(factor * _fitted(padded(linear, mask), style.size), 0, 1))
    return {"factor": factor, **picture_entry(pixels, style.quality)}


def gray_entry(values: FloatArray, mask: NDArray[np.bool_], style: TextureStyle) -> dict[str, Any]:
    """Return values (H, W) as 8 bits of their greatest, without loss; the viewer multiplies by `scale`."""
    from scan2albedo.applications.pictures import padded

    scale = float(values[mask].max()) if mask.any() else 0.0
    parts = padded(values[..., None], mask) / (scale or 1.0)
    pixels = np.round(255 * np.clip(_fitted(np.repeat(parts, 3, 2), style.size)[..., 0], 0, 1))
    return {"scale": scale, **picture_entry(pixels.astype(np.uint8), None)}


def picture_entry(pixels: NDArray[np.uint8], quality: int | None) -> dict[str, Any]:
    """Return 8-bit pixels as PNG, or as JPEG of a quality with full colour, in base64."""
    from PIL import Image

    data, image = io.BytesIO(), Image.fromarray(pixels)
    if quality is None:
        image.save(data, "PNG", optimize=True)
    else:
        image.save(data, "JPEG", quality=quality, subsampling=0, optimize=True)
    return {"type": "image/png" if quality is None else "image/jpeg", "data": encoded(data.getvalue())}


def picture_url(file: Path, width: int, quality: int) -> tuple[str, int, int] | None:
    """Return a picture file as the data URL of a JPEG at most `width` wide, and its size; None if damaged."""
    from PIL import Image

    try:
        with Image.open(file) as opened:
            picture = opened.convert("RGB")
    except (OSError, ValueError):
        return None
    if picture.width > width:
        height = max(1, round(picture.height * width / picture.width))
        picture = picture.resize((width, height), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=quality, optimize=True, progressive=True)
    return f"data:image/jpeg;base64,{encoded(data.getvalue())}", picture.width, picture.height


def _fitted(values: FloatArray, size: int) -> FloatArray:
    """Return an image (H, W, C) at most `size` texels wide and high, each the mean of what it covers."""
    height, width = values.shape[:2]
    if max(height, width) <= size:
        return values
    import cv2

    part = size / max(height, width)
    to = (max(1, round(width * part)), max(1, round(height * part)))
    return np.asarray(cv2.resize(values, to, interpolation=cv2.INTER_AREA), np.float64)
