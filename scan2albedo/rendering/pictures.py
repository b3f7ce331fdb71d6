"""What a camera sees of a mesh, sample by sample, and pictures made of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rasterization import rasterize
from scan2albedo.io.color import encode_srgb_bytes

DISTANCE_MM = 700.0
"""From the camera of a portrait to the middle of the face."""
PORTRAIT_MARGIN = 1.12
"""A portrait's width as a multiple of the face's."""


@dataclass(frozen=True)
class Picture:
    """What a camera sees."""

    linear: NDArray[np.float32]
    """(H, W, 3): colour before a black background."""
    alpha: NDArray[np.float32]
    """(H, W): the part of each pixel that the face covers."""

    def auto_exposure(self) -> float:
        """Return the factor that keeps the brightest parts just below white."""
        return auto_exposure(self.linear[self.alpha > 0])

    def srgb(self, exposure: float | None = None) -> NDArray[np.uint8]:
        """Return (H, W, 3) sRGB bytes of `exposure` times the picture, by itself when None, on white.

        ValueError for an exposure that is not finite and above 0.
        """
        factor = self.auto_exposure() if exposure is None else checked_exposure(exposure)
        shown = np.clip(factor * self.linear, 0, self.alpha[..., None])
        return encode_srgb_bytes(shown + (1 - self.alpha[..., None]))


def auto_exposure(linear: ArrayLike) -> float:
    """Return the factor that shows the bright part of colours (N, 3) just below white; 1 for black."""
    brightest = np.asarray(linear).reshape(-1, 3).max(-1)
    bright = float(np.percentile(brightest, 98)) if len(brightest) else 0.0
    return 0.8 / bright if bright > 0 else 1.0


def checked_exposure(exposure: float) -> float:
    """Return an exposure that is finite and above 0; others raise ValueError."""
    if not (np.isfinite(exposure) and exposure > 0):
        raise ValueError(f"exposure is {exposure}, expected a finite number above 0")
    return exposure


def portrait_frame(vertices: FloatArray) -> tuple[FloatArray, float, float]:
    """Return the middle (3,) of vertices (V, 3), half their greater width or height, and their depth."""
    low, high = vertices.min(0), vertices.max(0)
    return (low + high) / 2, 0.5 * float(np.max((high - low)[:2])), float((high - low)[2])


def portrait_camera(
    vertices: FloatArray, shape: tuple[int, int], azimuth_rad: float = 0.0, elevation_rad: float = 0.0
) -> FloatArray:
    """Return the (3, 4) camera of a portrait (H, W) that holds all vertices (V, 3), seen from a direction.

    The angles go from +z toward +x, and toward +y. ValueError for an azimuth that is not finite, an elevation
    beyond 89 degrees, or a shape below 2 pixels.
    """
    if not abs(elevation_rad) < np.deg2rad(89):
        raise ValueError(f"elevation_rad is {elevation_rad}, expected between -89 and 89 degrees")
    if not np.isfinite(azimuth_rad) or min(shape) < 2:
        raise ValueError(f"azimuth_rad is {azimuth_rad}, shape {shape}, expected finite and 2 pixels or more")
    middle, radius, depth = portrait_frame(vertices)
    level = np.cos(elevation_rad)
    toward = np.array([level * np.sin(azimuth_rad), np.sin(elevation_rad), level * np.cos(azimuth_rad)])
    distance = max(DISTANCE_MM, 4 * radius)
    focal = (min(shape) - 1) / (2 * PORTRAIT_MARGIN * radius) * (distance - depth / 2)
    return look_at(middle + distance * toward, middle, focal_px=focal, shape=shape)


@dataclass(frozen=True)
class SeenSamples:
    """The N of a picture's samples, `side` by `side` in each of its (H, W) pixels, that see a mesh.

    `index` (N,) counts samples row by row; each sees a point of the triangle of vertices `corners` (N, 3) at
    barycentric coordinates `weight` (N, 3).
    """

    shape: tuple[int, int]
    side: int
    index: IntArray
    corners: IntArray
    weight: FloatArray

    def chosen(self, which: NDArray) -> SeenSamples:
        """Return some of the samples."""
        return SeenSamples(self.shape, self.side, self.index[which], self.corners[which], self.weight[which])

    def interpolated(self, values: NDArray[np.floating]) -> FloatArray:
        """Return (N, ...) values (V, ...) of the vertices at the points seen."""
        return np.asarray(np.einsum("nk,nk...->n...", self.weight, values[self.corners]))

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
        below = np.einsum("nkc,nkc->nk", vertices[self.corners] - flat[:, None], normals[self.corners])
        if outward:
            below = np.maximum(below, 0.0)
        toward_planes = np.einsum("nk,nk,nkc->nc", self.weight, below, normals[self.corners])
        return np.asarray(flat + share * toward_planes)

    def picture(self, values: FloatArray) -> FloatArray:
        """Return (H, W, C) the means over each pixel's samples of values (N, C), 0 where nothing is seen."""
        (height, width), side = self.shape, self.side
        made = np.zeros((height * side * width * side, values.shape[1]))
        made[self.index] = values
        return np.asarray(made.reshape(height, side, width, side, -1).mean((1, 3)))


def seen_samples(
    vertices: FloatArray, faces: IntArray, camera: FloatArray, shape: tuple[int, int], side: int = 1
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
