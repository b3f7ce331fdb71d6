"""Brightness without shading: what a picture's light owes to the surface's normals is divided out."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model.appearance import light_basis
from scan2albedo.geometry.front_picture import FrontPicture

_SMOOTH_MM = 2.0
"""Depth is smoothed by it before it is derived: scanners' noise tilts normals."""
_DARKEST, _EVEN = 0.15, 0.02
"""Least light, relative to the usual one, and a deviation that nothing has to explain."""


def evenly_lit(picture: FrontPicture, brightness: FloatArray) -> FloatArray:
    """Return brightness (H, W) without what the light did to it.

    Of a matt surface it is about an albedo times a quadratic in the normal (Ramamoorthi and Hanrahan,
    SIGGRAPH 2001), fitted robustly here.
    """
    # The slopes of the depth, smoothed over the squares that have one.
    slopes, radius = [], _SMOOTH_MM / picture.step_mm
    for axis in (1, 0):
        known = picture.seen & np.roll(picture.seen, -1, axis) & np.roll(picture.seen, 1, axis)
        rise = np.roll(picture.depth, -1, axis) - np.roll(picture.depth, 1, axis)
        slope = gaussian_filter(np.where(known, rise / (2 * picture.step_mm), 0.0), radius)
        slopes.append(slope / np.maximum(gaussian_filter(known.astype(float), radius), 1e-3))
    normals = np.stack([-slopes[0], -slopes[1], np.ones_like(slopes[0])])
    basis = light_basis(np.moveaxis(normals / np.linalg.norm(normals, axis=0), 0, -1))
    used = np.zeros(picture.seen.shape, bool)
    # Squares in each second row and column are enough.
    used[::2, ::2] = picture.seen[::2, ::2]
    rows, values = basis[used], np.minimum(brightness, np.percentile(brightness[used], 99))[used]
    darkest = _DARKEST * max(float(np.median(values)), 1e-12)
    weight = np.ones(len(values))
    for _ in range(6):
        weighted = rows * weight[:, None]
        light = np.linalg.solve(weighted.T @ rows + 1e-4 * len(values) * np.eye(9), weighted.T @ values)
        off = np.abs(values - rows @ light) / np.maximum(rows @ light, darkest)
        weight = 1 / (1 + (off / max(1.5 * float(np.median(off)), _EVEN)) ** 2)
    return np.asarray(np.where(picture.seen, brightness / np.maximum(basis @ light, darkest), 0.0))
