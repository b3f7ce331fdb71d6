"""Quick shaded pictures of meshes, for overviews and for looking at what a stage made."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.geometry.rigid import rotation_from_vector


def render_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    vertex_color_srgb: ArrayLike | None = None,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    size: int = 512,
    shaded: bool = True,
    frame_mm: tuple[ArrayLike, float] | None = None,
) -> NDArray[np.uint8]:
    """Render a mesh orthographically from the front (+z), turned by yaw and pitch.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        +x to the right of the picture, +y up, +z to the viewer.
    faces : (F, 3) array_like of int
    vertex_color_srgb : (V, 3) array_like of float in [0, 1], optional
        Grey when omitted.
    yaw_deg, pitch_deg : float
        Turn of the head: positive yaw shows its right side (the viewer moves to -x), positive pitch
        shows it from below.
    size : int
        Height and width in pixels.
    shaded : bool
        Multiply colours by a headlight's shading.
    frame_mm : (center (3,), half width), optional
        What to show; the bounding box when omitted.

    Returns
    -------
    (size, size, 3) uint8, sRGB, white background.
    """
    xyz, index = np.asarray(vertices, float), np.asarray(faces, np.int64)
    if frame_mm is None:
        low, high = xyz.min(0), xyz.max(0)
        center, half = (low + high) / 2, float(np.max(high - low)) * 0.55
    else:
        center, half = np.asarray(frame_mm[0], float), float(frame_mm[1])
    turn = rotation_from_vector([np.deg2rad(-pitch_deg), 0, 0]) @ rotation_from_vector(
        [0, np.deg2rad(yaw_deg), 0]
    )
    seen = (xyz - center) @ turn.T
    scale = (size - 1) / (2 * half)
    pixels = np.stack([(seen[:, 0] + half) * scale, (half - seen[:, 1]) * scale], 1)
    raster = rasterize(pixels, seen[:, 2], index, (size, size))
    color = np.full((len(xyz), 3), 0.8) if vertex_color_srgb is None else np.asarray(vertex_color_srgb, float)
    picture = interpolate(raster, index, color)
    if shaded:
        normals = normalized(interpolate(raster, index, vertex_normals(seen, index)))
        light = normalized(np.array([0.35, 0.45, 0.82]))
        picture *= (0.25 + 0.75 * np.abs(normals @ light))[..., None]
    picture[~raster.covered] = 1.0
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)


def heat_colors(values: ArrayLike, low: float, high: float, colormap: str = "viridis") -> NDArray[np.float64]:
    """Return (N, 3) sRGB colours in [0, 1] of values mapped linearly from [low, high]; NaN is grey."""
    from matplotlib import colormaps

    array = np.asarray(values, float)
    colors = colormaps[colormap](np.clip((array - low) / (high - low), 0, 1))[..., :3]
    return np.where(np.isnan(array)[..., None], 0.6, colors)
