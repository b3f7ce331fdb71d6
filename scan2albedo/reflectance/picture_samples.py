"""Pictures as light, looked up at the vertices of a mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rasterization import bilinear

_UNIT = 1e-3
"""How far a normal's length may be from 1."""
_LEAST_WEIGHT = 1e-6
"""Of valid pixels around a gap, below which it is not filled."""


def checked_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3), or raise `ValueError` for other shapes."""
    xyz, index = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or index.ndim != 2 or index.shape[1] != 3:
        raise ValueError(f"vertices is {xyz.shape} and faces {index.shape}, expected (V, 3) and (F, 3)")
    return xyz, index


def checked_normals(xyz: FloatArray, faces: IntArray, normals: ArrayLike | None) -> FloatArray:
    """Return the normals (V, 3) given, or those of the mesh; 0 where there are none.

    Raises `ValueError` for another shape, `ReflectanceError` when vertices or normals are not finite, normals
    not unit, or faces hold no triangles of the vertices.
    """
    if not np.isfinite(xyz).all():
        raise ReflectanceError("vertices are not all finite")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(xyz):
        raise ReflectanceError(f"faces hold no triangles, or others than of the {len(xyz)} vertices")
    if normals is None:
        return vertex_normals(xyz, faces)
    given = np.ascontiguousarray(normals, np.float64)
    if given.shape != xyz.shape:
        raise ValueError(f"normals is {given.shape}, expected {xyz.shape} as vertices")
    length = np.linalg.norm(given, axis=1)
    off = ~((np.abs(length - 1) < _UNIT) | (length == 0))
    if off.any():
        first = int(np.flatnonzero(off)[0])
        raise ReflectanceError(
            f"the normal of vertex {first} has length {length[first]:.4g}, expected 1 (or 0)"
        )
    return given


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear_samples(picture, sigma, valid, pixels, usable, spread, value, variance, found):  # type: ignore[no-untyped-def]
    """Fill value, variance and found (V, 3) of the `usable` vertices at pixels (V, 2).

    `spread` is the variance of a vertex's position, px^2.
    """
    height, width = picture.shape[:2]
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        if not usable[i] or not (0.0 <= x <= width - 1.0 and 0.0 <= y <= height - 1.0):
            continue
        left, top = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
        fx, fy = x - left, y - top
        for k in range(3):
            if not (
                valid[top, left, k]
                and valid[top, right, k]
                and valid[bottom, left, k]
                and valid[bottom, right, k]
            ):
                continue
            a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
            p, q = picture[top, left, k], picture[top, right, k]
            r, s = picture[bottom, left, k], picture[bottom, right, k]
            value[i, k] = a * p + b * q + c * r + d * s
            across, down = (q - p + s - r) / 2, (r - p + s - q) / 2
            # Each slope's own noise has this variance.
            noise = (
                sigma[top, left, k] ** 2
                + sigma[top, right, k] ** 2
                + sigma[bottom, left, k] ** 2
                + sigma[bottom, right, k] ** 2
            ) / 4
            variance[i, k] = (
                (a * sigma[top, left, k]) ** 2
                + (b * sigma[top, right, k]) ** 2
                + (c * sigma[bottom, left, k]) ** 2
                + (d * sigma[bottom, right, k]) ** 2
                + spread * max(across * across + down * down - 2 * noise, 0.0)
            )
            found[i, k] = True


def picture_values(picture: NDArray[Any], name: str, saturation: float) -> FloatArray:
    """Return values (H, W, 3), white = 1, of floats or of integers of 8 or 16 bits.

    Raises `ReflectanceError` for another dtype, or when floats reach twice the saturation.
    """
    array = np.asarray(picture)
    if array.dtype in (np.uint8, np.uint16):
        return np.asarray(array / float(np.iinfo(array.dtype).max))
    if not np.issubdtype(array.dtype, np.floating):
        raise ReflectanceError(f"{name} is {array.dtype}, expected floats with white = 1, uint8 or uint16")
    values = array.astype(np.float64)
    largest = float(np.max(values, where=np.isfinite(values), initial=0.0))
    if largest > 2 * saturation:
        raise ReflectanceError(
            f"{name} reaches {largest:.4g}, expected values with white = 1: divide by the largest value the "
            "camera can give, or set `saturation` in the options for pictures beyond white"
        )
    return values


def linear_values(values: FloatArray, gamma: float) -> FloatArray:
    """Return values^gamma, odd, so that noise around 0 keeps its mean."""
    return np.copysign(np.abs(values) ** gamma, values)


class SmoothImage:
    """A linear image (H, W, 3), smoothed by a Gaussian over its valid pixels only, bilinear between pixels.

    Pixels that are not finite, or False in the mask (H, W), are gaps; a standard deviation of 0 smooths
    nothing. Raises `ReflectanceError` when no pixel is left, `ValueError` for other shapes.
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
        return bilinear(self._image, pixels)

    def gradient(self, pixels: FloatArray) -> FloatArray:
        """Return the derivatives (N, 3, 2) of `look_up` by column and row; 0 beyond the border."""
        left, top, fx, fy = self._cells(pixels)
        a, b = self._image[top, left], self._image[top, left + 1]
        c, d = self._image[top + 1, left], self._image[top + 1, left + 1]
        slopes = np.stack([(1 - fy) * (b - a) + fy * (d - c), (1 - fx) * (c - a) + fx * (d - b)], 2)
        height, width = self.valid.shape
        inside = (pixels > 0) & (pixels < [width - 1, height - 1])
        return np.asarray(slopes * inside[:, None, :])

    def _cells(self, pixels: FloatArray) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
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
