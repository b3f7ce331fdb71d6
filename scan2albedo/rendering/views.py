"""Quick orthographic pictures of meshes, for overviews."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rasterization import Raster, interpolate, pixels_from_uv, rasterize
from scan2albedo.geometry.rigid import rotation_from_vector


@dataclass(frozen=True)
class View:
    """Where a picture looks from: orthographic, from the front (+z) at yaw = pitch = 0."""

    center_mm: tuple[float, float, float]
    """Point in the middle of the picture."""
    half_width_mm: float
    """Half of the picture's width and height."""
    yaw_deg: float = 0.0
    """Turn of the head: positive shows its right side (the viewer moves to -x)."""
    pitch_deg: float = 0.0
    """Nod of the head: positive shows it from below."""

    @classmethod
    def around(cls, vertices: ArrayLike, *, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> View:
        """Return the view that holds all of the (V, 3) vertices."""
        xyz = np.asarray(vertices, float)
        low, high = xyz.min(0), xyz.max(0)
        x, y, z = (low + high) / 2
        return cls((x, y, z), float(np.max(high - low)) * 0.55, yaw_deg, pitch_deg)

    @property
    def rotation(self) -> FloatArray:
        """(3, 3): its rows point right, up and toward the viewer."""
        nod = rotation_from_vector([np.deg2rad(-self.pitch_deg), 0, 0])
        return np.asarray(nod @ rotation_from_vector([0, np.deg2rad(self.yaw_deg), 0]))

    def project(self, vertices: ArrayLike) -> FloatArray:
        """Return (V, 3) coordinates relative to the centre: right, up, toward the viewer."""
        return np.asarray((np.asarray(vertices, float) - np.asarray(self.center_mm)) @ self.rotation.T)

    def pixels(self, vertices: ArrayLike, size: int) -> FloatArray:
        """Return the places (V, 2), column and row, of vertices in a picture of `size` pixels a side."""
        seen, half = self.project(vertices), self.half_width_mm
        scale = (size - 1) / (2 * half)
        return np.stack([(seen[:, 0] + half) * scale, (half - seen[:, 1]) * scale], 1)

    def raster(self, vertices: ArrayLike, faces: ArrayLike, size: int) -> Raster:
        """Return which face covers each of `size` x `size` pixels, the nearest one, and where."""
        return rasterize(self.pixels(vertices, size), self.project(vertices)[:, 2], faces, (size, size))


def render_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    vertex_color_srgb: ArrayLike | None = None,
    texture_srgb: tuple[ArrayLike, NDArray[np.uint8]] | None = None,
    view: View | None = None,
    size: int = 512,
    shaded: bool = True,
) -> NDArray[np.uint8]:
    """Render a mesh orthographically as (size, size, 3) uint8 sRGB before white.

    `vertices` (V, 3): +x to the right, +y up, +z to the viewer. `vertex_color_srgb` (V, 3) is within [0, 1],
    grey when None; `texture_srgb`, the uv of each face's corners (F, 3, 2) and an image (H, W, 3), goes
    before it. Without `view` all of the mesh is shown from the front. `shaded` multiplies colours by a
    headlight's shading.
    """
    xyz, index = np.asarray(vertices, float), np.asarray(faces, np.int64)
    view = view if view is not None else View.around(xyz)
    raster = view.raster(xyz, index, size)
    if texture_srgb is not None:
        corners, image = np.asarray(texture_srgb[0], float), texture_srgb[1]
        uv = np.einsum("nk,nkc->nc", raster.barycentric[raster.covered], corners[raster.face[raster.covered]])
        pixels = np.round(pixels_from_uv(uv, image.shape[:2])).astype(np.int64)
        column, row = np.clip(pixels, 0, [image.shape[1] - 1, image.shape[0] - 1]).T
        picture = np.zeros((size, size, 3))
        picture[raster.covered] = image[row, column] / 255.0
    else:
        grey = np.full((len(xyz), 3), 0.8)
        color = grey if vertex_color_srgb is None else np.asarray(vertex_color_srgb, float)
        picture = interpolate(raster, index, color)
    if shaded:
        normals = normalized(interpolate(raster, index, vertex_normals(view.project(xyz), index)))
        picture *= (0.25 + 0.75 * np.abs(normals @ normalized(np.array([0.35, 0.45, 0.82]))))[..., None]
    picture[~raster.covered] = 1.0
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)


def heat_colors(values: ArrayLike, low: float, high: float, colormap: str = "viridis") -> FloatArray:
    """Return (N, 3) sRGB colours in [0, 1] of values mapped linearly from [low, high]; NaN is grey."""
    from matplotlib import colormaps

    array = np.asarray(values, float)
    colors = colormaps[colormap](np.clip((array - low) / (high - low), 0, 1))[..., :3]
    return np.where(np.isnan(array)[..., None], 0.6, colors)
