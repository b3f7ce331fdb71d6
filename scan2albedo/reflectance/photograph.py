"""A photograph of a face whose geometry and camera are known, as an `ImageObservation`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers, normalized_cameras, project
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.light_transfer import light_transfer
from scan2albedo.reflectance.picture_samples import (
    bilinear_samples,
    checked_mesh,
    checked_normals,
    linear_values,
    picture_values,
)
from scan2albedo.reflectance.vertex_visibility import VertexVisibility

_VIEW_COSINE = 0.1
"""n.v must be above this."""


@dataclass(frozen=True)
class PhotographOptions:
    """How displayed values become light, and when a vertex counts as seen.

    Raises `ValueError` when a value is outside its range.
    """

    gamma: float = 1.2
    """Light is value^gamma; 1 for pictures that are linear already."""
    saturation: float = 0.98
    """Values from here on are clipped, or may be; inf for pictures that cannot clip."""
    margin_px: float = 1.5
    """Distance in the picture from edges of the surface; 0 asks for none."""
    shadow_directions: int = 1024
    """Directions of `light_transfer`; 0 leaves shadows out."""

    def __post_init__(self) -> None:
        if not 0 < self.gamma < math.inf:
            raise ValueError(f"gamma is {self.gamma}, expected > 0 and finite")
        if not self.saturation > 0:
            raise ValueError(f"saturation is {self.saturation}, expected > 0")
        for name in ("margin_px", "shadow_directions"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 or more")


def observe_photograph(
    image: NDArray[Any],
    camera: ArrayLike,
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    options: PhotographOptions = PhotographOptions(),
) -> ImageObservation:
    """Look up a face's vertices in a photograph, where the camera sees them well.

    A vertex counts when nothing hides it, it is not seen at too flat an angle nor near an edge in depth, and
    the four pixels around it are skin, finite and not saturated in any channel. Their light, value^gamma, is
    interpolated. Cost: three rays and a half a vertex and camera, and `light_transfer`: 3,700 vertices take
    about a second.

    Parameters
    ----------
    image : (H, W, 3) array
        Displayed values: floats, white = 1, or integers of 8 or 16 bits; NaN where there is nothing.
    camera : (3, 4) array_like of float
        Projection matrix: pixels (column, row), centres at integers, from points in mm.
    vertices : (V, 3) array_like of float
        Millimetres.
    faces : (F, 3) array_like of int
        Of all that hides vertices or casts shadows.
    normals : (V, 3) array_like of float, optional
        Unit; those of the mesh when omitted. A vertex whose normal is 0 is never seen.
    mask : (H, W) array_like of bool, optional
        True on skin; all pixels when omitted.
    options : PhotographOptions

    Returns
    -------
    ImageObservation
        In the frame of the mesh, with its transfer.

    Raises
    ------
    ReflectanceError
        When no vertex counts (names the step at which the last ones were lost), the image is black there,
        holds numbers of another type, or the camera or the mesh cannot be used.
    ValueError
        When shapes disagree.
    """
    xyz, index = checked_mesh(vertices, faces)
    normal = normalized(checked_normals(xyz, index, normals))
    matrix = _checked_camera(camera)
    linear, finite, saturated = _light(image, options)
    skin = _checked_mask(mask, linear.shape[:2])
    center = camera_centers(matrix[None])[0]
    toward = normalized(center - xyz)
    visibility = VertexVisibility(xyz, index, normal)
    seen = visibility.seen(matrix, _VIEW_COSINE, options.margin_px)
    pixels, _ = project(matrix, xyz)
    color, found = _usable(linear, skin, finite, saturated, pixels, seen)
    observed = np.where(found[:, None], color, np.nan)
    if not options.shadow_directions:
        return ImageObservation(observed, normal, toward, found)
    transfer = light_transfer(xyz, index, normal, toward, directions=options.shadow_directions)
    return ImageObservation(observed, normal, toward, found, transfer)


def _usable(
    linear: NDArray[np.float32],
    skin: BoolArray,
    finite: BoolArray,
    saturated: BoolArray,
    pixels: FloatArray,
    seen: BoolArray,
) -> tuple[FloatArray, BoolArray]:
    """Return colours (V, 3) and which vertices (V,) can be used; raise, with the reason, when none can."""
    steps = {
        "inside the picture": np.ones_like(skin),
        "on the mask": skin,
        "with finite colours": skin & finite,
        "not saturated": skin & finite & ~saturated,
    }
    color, found = _samples(linear, steps["not saturated"], pixels, seen)
    if not found.any():
        counts = {name: _samples(linear, valid, pixels, seen)[1].sum() for name, valid in steps.items()}
        left = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise ReflectanceError(
            f"no vertex of {len(seen)} can be used: {seen.sum()} are seen by the camera, {left}; check "
            "camera, mask and exposure in this order"
        )
    return color, found


def _samples(
    linear: NDArray[np.float32], valid: BoolArray, pixels: FloatArray, seen: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Return colours (V, 3) at pixels (V, 2) and which vertices (V,) have four valid pixels around them."""
    shape = (len(pixels), 3)
    value, variance, found = np.zeros(shape), np.zeros(shape), np.zeros(shape, bool)
    channels = np.ascontiguousarray(np.broadcast_to(valid[..., None], linear.shape))
    noiseless = np.zeros_like(linear)
    bilinear_samples(linear, noiseless, channels, pixels, seen, 0.0, value, variance, found)
    return value, np.asarray(found.all(1))


def _light(
    image: NDArray[Any], options: PhotographOptions
) -> tuple[NDArray[np.float32], BoolArray, BoolArray]:
    """Return light (H, W, 3), 0 where there is none, and which pixels are finite and saturated (H, W)."""
    if np.ndim(image) != 3 or np.shape(image)[2] != 3 or np.size(image) == 0:
        raise ValueError(f"image is {np.shape(image)}, expected (H, W, 3)")
    values = picture_values(np.asarray(image), "the image", options.saturation)
    finite = np.asarray(np.isfinite(values).all(-1))
    values = np.where(finite[..., None], values, 0.0)
    saturated = np.asarray((values >= options.saturation).any(-1))
    return linear_values(values, options.gamma).astype(np.float32), finite, saturated


def _checked_mask(mask: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray:
    if mask is None:
        return np.ones(shape, bool)
    skin = np.asarray(mask)
    if skin.shape != shape or skin.dtype != np.bool_:
        raise ValueError(f"mask is {skin.dtype} {skin.shape}, expected bool {shape} as the image")
    return skin


def _checked_camera(camera: ArrayLike) -> FloatArray:
    matrix = np.asarray(camera, np.float64)
    if matrix.shape != (3, 4):
        raise ValueError(f"camera is {matrix.shape}, expected (3, 4)")
    try:
        return np.asarray(normalized_cameras(matrix[None])[0])
    except ValueError as error:
        raise ReflectanceError(f"the camera cannot be used: {error}") from error
