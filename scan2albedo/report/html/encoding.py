"""Meshes and pictures in few bytes: 16 bits a number, triangles shared by scans, textures as PNG or JPEG."""

from __future__ import annotations

import base64
import hashlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from scan2albedo.applications.processed_face import FaceMesh
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.geometry_image import GeometryImage, wound_like
from scan2albedo.geometry.area_mean import area_mean
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.report.overview import white_level

_LEVELS = np.iinfo(np.uint16).max


def encoded(data: bytes) -> str:
    """Return bytes as base64 text."""
    return base64.b64encode(data).decode("ascii")


def quantized(values: FloatArray, low: FloatArray, span: FloatArray) -> NDArray[np.uint16]:
    """Return values between `low` and `low + span` as little-endian 16-bit parts of the span."""
    parts = (values - low) / np.where(span > 0, span, 1.0)
    return np.round(np.clip(parts, 0, 1) * _LEVELS).astype("<u2")


def octahedral(normals: FloatArray) -> NDArray[np.int16]:
    """Return (V, 2) 16-bit octahedral coordinates of unit vectors (Cigolle et al., JCGT 3(2), 2014)."""
    flat = normals / np.maximum(np.abs(normals).sum(1, keepdims=True), 1e-12)
    sign = np.where(flat[:, :2] >= 0, 1.0, -1.0)
    folded = np.where(flat[:, 2:] < 0, (1 - np.abs(flat[:, 1::-1])) * sign, flat[:, :2])
    return np.round(np.clip(folded, -1, 1) * 32767).astype("<i2")


def mesh_entry(mesh: FaceMesh, topologies: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return a mesh as the viewer reads it; positions are off by half of a 65535th of the box at most.

    Its triangles and chart coordinates go to `topologies`, {key: {"faces", "uv", "wide"}}, once for all
    scans of a report.
    """
    wide = len(mesh.uv) > _LEVELS
    index = np.ascontiguousarray(mesh.faces, "<u4" if wide else "<u2").tobytes()
    chart = quantized(np.clip(mesh.uv, 0, 1), np.zeros(2), np.ones(2)).tobytes()
    key = hashlib.sha256(index + chart).hexdigest()[:12]
    topologies[key] = {"faces": encoded(index), "uv": encoded(chart), "wide": wide}
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    box = {"low": low.tolist(), "span": (high - low).tolist()}
    positions = encoded(quantized(mesh.vertices, low, high - low).tobytes())
    normals = encoded(octahedral(mesh.normals).tobytes())
    return {"topology": key, "positions": positions, "normals": normals, **box}


def thinned_chart(image: GeometryImage, most: int = 60_000) -> FaceMesh:
    """Return the texel grid as a mesh of about `most` vertices or fewer.

    Blocks inside the mask become two triangles; those at the rim and at seams keep all their triangles, so
    that no gap opens.
    """
    full, step = FaceMesh.of_chart(image), 1
    while int(image.mask.sum()) / step**2 > most:
        step += 1
    if step == 1:
        return full
    index = np.full(image.shape, -1, np.int64)
    index[image.mask] = np.arange(len(full.vertices))
    rows, columns = (np.arange(0, size - step, step) for size in image.shape)
    blocks = sliding_window_view(image.mask, (step + 1, step + 1))[::step, ::step]
    whole = np.asarray(blocks.all(axis=(2, 3)))
    a, b, c, d = (
        index[np.ix_(rows + down, columns + right)][whole] for down in (0, step) for right in (0, step)
    )
    coarse = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    # Triangles of the texel grid that no whole block covers stay.
    row, column = (texels[full.faces].min(1) // step for texels in np.nonzero(image.mask))
    inside = (row < whole.shape[0]) & (column < whole.shape[1])
    covered = np.zeros(len(full.faces), bool)
    covered[inside] = whole[row[inside], column[inside]]
    agreed = wound_like(full.vertices, np.concatenate([coarse, full.faces[~covered]]), full.normals)
    used, place = np.unique(agreed, return_inverse=True)
    return FaceMesh(full.vertices[used], place.reshape(-1, 3), full.uv[used])


def texture_entry(
    linear: NDArray[np.floating],
    mask: BoolArray,
    size: int,
    *,
    quality: int | None = None,
    factor: float | None = None,
) -> dict[str, Any]:
    """Return a linear texture (H, W, 3) as 8-bit sRGB for the viewer, continued beyond the mask (H, W).

    Its longest side has at most `size` texels; a JPEG of a quality, or PNG without loss. The texture is
    multiplied by `factor`, by which the viewer divides; when None, its `white_level` is 1.
    """
    factor = 1 / white_level(linear, mask) if factor is None else factor
    return {"factor": factor, **picture_entry(_pixels(linear, mask, size, factor), quality)}


def patch_entry(
    linear: NDArray[np.floating], under: NDArray[np.floating], mask: BoolArray, size: int, factor: float
) -> dict[str, Any]:
    """Return a texture (H, W, 3) as what is to be drawn over that of `under`, clear where the two agree."""
    over, below = (_pixels(texture, mask, size, factor) for texture in (linear, under))
    differs = (over != below).any(-1, keepdims=True)
    return picture_entry(np.concatenate([over, np.full_like(over[..., :1], 255)], -1) * differs, None)


def _pixels(linear: NDArray[np.floating], mask: BoolArray, size: int, factor: float) -> NDArray[np.uint8]:
    return encode_srgb_bytes(np.clip(factor * _fitted(filled_from_nearest(linear, mask), size), 0, 1))


def gray_entry(values: FloatArray, mask: BoolArray, size: int) -> dict[str, Any]:
    """Return values (H, W) as 8 bits of their greatest, without loss; the viewer multiplies by `scale`."""
    scale = float(values[mask].max()) if mask.any() else 0.0
    parts = _fitted(filled_from_nearest(values[..., None], mask) / (scale or 1.0), size)[..., 0]
    return {"scale": scale, **picture_entry(np.round(255 * np.clip(parts, 0, 1)).astype(np.uint8), None)}


def picture_entry(pixels: NDArray[np.uint8], quality: int | None) -> dict[str, Any]:
    """Return 8-bit pixels as PNG, or as JPEG of a quality with full colour, in base64."""
    from PIL import Image

    data, image = io.BytesIO(), Image.fromarray(pixels)
    if quality is None:
        image.save(data, "PNG", optimize=True)
    else:
        image.save(data, "JPEG", quality=quality, subsampling=0, optimize=True)
    return {"type": "image/png" if quality is None else "image/jpeg", "data": encoded(data.getvalue())}


def picture_url(file: Path, width: int) -> tuple[str, int, int] | None:
    """Return a picture file as the data URL of a JPEG at most `width` wide, and its size; None if damaged."""
    from PIL import Image

    if not file.is_file():  # a pipe may never end
        return None
    try:
        with Image.open(file) as opened:
            picture = opened.convert("RGB")
    except (OSError, ValueError):
        return None
    if picture.width > width:
        height = max(1, round(picture.height * width / picture.width))
        picture = picture.resize((width, height), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=80, optimize=True, progressive=True)
    return f"data:image/jpeg;base64,{encoded(data.getvalue())}", picture.width, picture.height


def _fitted(values: FloatArray, size: int) -> FloatArray:
    """Return an image (H, W, C) at most `size` texels wide and high, each the mean of what it covers."""
    height, width = values.shape[:2]
    part = size / max(height, width)
    if part >= 1:
        return values
    return area_mean(values, (max(1, round(height * part)), max(1, round(width * part))))
