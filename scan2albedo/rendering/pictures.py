"""What a camera sees of a mesh, sample by sample, pictures made of it, and quick orthographic ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import (
    ArrayLike,
    ByteArray,
    Float32Array,
    FloatArray,
    GridShape,
    IntArray,
    NDArray,
    RealArray,
    brightest,
    dots,
)
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.pinhole import project
from scan2albedo.geometry.rasterization import Raster, interpolate, pixels_from_uv, rasterize
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.io.color import encode_srgb_bytes, hex_colors, linear_to_srgb

COLORMAPS = {
    "viridis": "440154481b6d46327e3f4788365c8d2e6e8e277f8e21918c1fa1872db27d4ac16d73d056a0da39d0e11cfde725",
    "inferno": "0000040d0829280b53470b6a65156e82206c9f2a63bc3754d44842e8602df57d15fc9f07fac228f3e55dfcffa4",
}
"""Colours at equal steps of matplotlib's colormaps; between them these are off by at most 8 of 255."""
DISTANCE_MM = 700.0
"""From the camera of a portrait to the middle of the face."""
PORTRAIT_MARGIN = 1.12
"""A portrait's width as a multiple of the face's."""


@dataclass(frozen=True)
class Picture:
    """What a camera sees."""

    linear: Float32Array
    """(H, W, 3): colour before a black background."""
    alpha: Float32Array
    """(H, W): the part of each pixel that the face covers."""

    def auto_exposure(self) -> float:
        """Return the factor that keeps the brightest parts just below white."""
        return auto_exposure(self.linear[self.alpha > 0])

    def srgb(self, exposure: float | None = None) -> ByteArray:
        """Return (H, W, 3) sRGB bytes of `exposure` times the picture, by itself when None, on white.

        ValueError for an exposure that is not finite and above 0.
        """
        factor = self.auto_exposure() if exposure is None else checked_exposure(exposure)
        shown = np.clip(factor * self.linear, 0, self.alpha[..., None])
        return encode_srgb_bytes(shown + (1 - self.alpha[..., None]))


def auto_exposure(linear: ArrayLike) -> float:
    """Return the factor that shows the bright part of colours (N, 3) just below white; 1 for black."""
    value = brightest(linear).ravel()
    bright = float(np.percentile(value, 98)) if len(value) else 0.0
    return 0.8 / bright if bright > 0 else 1.0


def checked_exposure(exposure: float) -> float:
    """Return an exposure that is finite and above 0; others raise ValueError."""
    if not (np.isfinite(exposure) and exposure > 0):
        raise ValueError(f"exposure is {exposure}, expected a finite number above 0")
    return exposure


def portrait_frame(vertices: FloatArray) -> tuple[FloatArray, float, float]:
    """Return the middle (3,) of vertices (V, 3), half their greater width or height, and their depth."""
    low, high = vertices.min(0), vertices.max(0)
    return (low + high) / 2, float(np.max((high - low)[:2])) / 2, float((high - low)[2])


@dataclass(frozen=True)
class SeenSamples:
    """The N of a picture's samples, `side` by `side` in each of its (H, W) pixels, that see a mesh.

    `index` (N,) counts samples row by row; each sees a point of the triangle of vertices `corners` (N, 3) at
    barycentric coordinates `weight` (N, 3).
    """

    shape: GridShape
    side: int
    index: IntArray
    corners: IntArray
    weight: FloatArray

    @property
    def place(self) -> IntArray:
        """(N, 2): row and column of each sample."""
        return np.column_stack(np.divmod(self.index, self.shape[1] * self.side))

    def chosen(self, which: NDArray) -> SeenSamples:
        """Return some of the samples."""
        return SeenSamples(self.shape, self.side, self.index[which], self.corners[which], self.weight[which])

    def joined(self, others: SeenSamples) -> SeenSamples:
        """Return these samples and others of one picture, which may see another mesh."""
        pairs = [(getattr(self, name), getattr(others, name)) for name in ("index", "corners", "weight")]
        return SeenSamples(self.shape, self.side, *map(np.concatenate, pairs))

    def interpolated(self, values: RealArray) -> FloatArray:
        """Return (N, ...) values (V, ...) of the vertices at the points seen."""
        return self._weights(len(values)) @ values

    def _weights(self, count: int) -> sparse.csr_array:
        """Return the matrix (N, V) of the corners' weights, for a mesh of V vertices."""
        ends = np.arange(0, self.corners.size + 1, 3)
        return sparse.csr_array((self.weight.ravel(), self.corners.ravel(), ends), (len(self.index), count))

    def raised(
        self, vertices: FloatArray, normals: FloatArray, share: float = 1.0, *, outward: bool = False
    ) -> FloatArray:
        """Return (N, 3) the points seen, moved to the curved surface that the triangles stand for.

        Between the triangle, `share` 0, and the mean of the tangent planes at its corners, 1 [1]_; with
        `outward` no point moves inward, so that no facet shadows itself [2]_.

        References
        ----------
        .. [1] T. Boubekeur, M. Alexa, "Phong tessellation", ACM Transactions on Graphics 27(5), 2008.
        .. [2] J. Hanika, "Hacking the shadow terminator", Ray Tracing Gems II, 2021.
        """
        flat = self.interpolated(vertices)
        if share == 0:
            return flat
        below = dots(vertices[self.corners] - flat[:, None], normals[self.corners])
        if outward:
            below = np.maximum(below, 0.0)
        toward_planes = np.einsum("nk,nk,nkc->nc", self.weight, below, normals[self.corners])
        return flat + share * toward_planes

    def picture(self, values: FloatArray) -> FloatArray:
        """Return (H, W, C) the means over each pixel's samples of values (N, C), 0 where nothing is seen."""
        (height, width), side = self.shape, self.side
        made = np.zeros((height * side * width * side, values.shape[1]))
        made[self.index] = values
        return made.reshape(height, side, width, side, -1).mean((1, 3))


def seen_samples(
    vertices: FloatArray, faces: IntArray, camera: FloatArray, shape: GridShape, side: int = 1
) -> SeenSamples:
    """Return what a normalised camera (3, 4) sees of a mesh in `side` x `side` samples of each pixel.

    Both sides of a triangle are seen; those with a corner behind the camera are left out.
    """
    pixels, depth = project(camera, vertices)
    ahead = depth > 0
    kept = faces[ahead[faces].all(1)]
    fine = side * np.where(ahead[:, None], pixels, 0.0) + (side - 1) / 2
    nearness = 1 / np.where(ahead, depth, 1.0)
    raster = rasterize(fine, nearness, kept, (shape[0] * side, shape[1] * side))
    index = np.flatnonzero(raster.covered)
    corners = kept[raster.face.ravel()[index]]
    # In the picture 1 / depth is linear over a triangle, the surface's own coordinates are not.
    weight = raster.barycentric.reshape(-1, 3)[index] * nearness[corners]
    return SeenSamples(shape, side, index, corners, weight / weight.sum(1, keepdims=True))


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
        return nod @ rotation_from_vector([0, np.deg2rad(self.yaw_deg), 0])

    def project(self, vertices: ArrayLike) -> FloatArray:
        """Return (V, 3) coordinates relative to the centre: right, up, toward the viewer."""
        return (np.asarray(vertices, float) - np.asarray(self.center_mm)) @ self.rotation.T

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
    texture: tuple[ArrayLike, ByteArray | Float32Array] | None = None,
    view: View | None = None,
    size: int = 512,
    shaded: bool = True,
) -> ByteArray:
    """Render a mesh orthographically as (size, size, 3) uint8 sRGB before white.

    `vertices` (V, 3): +x to the right, +y up, +z to the viewer. `vertex_color_srgb` (V, 3) is within [0, 1],
    grey when None; `texture`, the uv of each face's corners (F, 3, 2) and an image (H, W, 3), sRGB bytes or
    linear floats, goes before it. Without `view` all of the mesh is shown from the front. `shaded`
    multiplies colours by a headlight's shading.
    """
    xyz, index = np.asarray(vertices, float), np.asarray(faces, int)
    view = view if view is not None else View.around(xyz)
    raster = view.raster(xyz, index, size)
    covered = raster.covered
    if texture is not None:
        corners, image = np.asarray(texture[0], float), texture[1]
        uv = np.einsum("nk,nkc->nc", raster.barycentric[covered], corners[raster.face[covered]])
        pixels = np.round(pixels_from_uv(uv, image.shape[:2])).astype(int)
        column, row = np.clip(pixels, 0, [image.shape[1] - 1, image.shape[0] - 1]).T
        colors = image[row, column]
        colors = colors / 255 if colors.dtype == np.uint8 else linear_to_srgb(np.clip(colors, 0, 1))
    elif vertex_color_srgb is not None:
        colors = interpolate(raster, index, np.asarray(vertex_color_srgb, float))[covered]
    else:
        colors = np.array([[0.8]])
    if shaded:
        normals = normalized(interpolate(raster, index, vertex_normals(view.project(xyz), index))[covered])
        light = np.abs(normals @ normalized(np.array([0.35, 0.45, 0.82])))
        colors = colors * (0.25 + 0.75 * light)[:, None]
    picture = np.full((size, size, 3), 255, np.uint8)
    picture[covered] = np.round(np.clip(colors, 0, 1) * 255)
    return picture


def heat_colors(values: ArrayLike, low: float, high: float, colormap: str = "viridis") -> FloatArray:
    """Return (N, 3) sRGB colours in [0, 1] of values mapped linearly from [low, high]; NaN is grey.

    `colormap` is one of `COLORMAPS`.
    """
    array, stops = np.asarray(values, float), hex_colors(COLORMAPS[colormap]) / 255
    place = np.clip((array - low) / (high - low), 0, 1) * (len(stops) - 1)
    colors = [np.interp(place, range(len(stops)), channel) for channel in stops.T]
    return np.where(np.isnan(array)[..., None], 0.6, np.stack(colors, -1))
