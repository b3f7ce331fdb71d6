"""Pictures of a processed face from a camera, lit pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.applications.scene_light import SceneLight, shade
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import (
    camera_centers,
    look_at,
    normalized_cameras,
    pixel_directions,
    pixel_grid,
)
from scan2albedo.geometry.rasterization import pixels_from_uv
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.lighting.shadow_map import ShadowMap

FloatArray = NDArray[np.float64]

DISTANCE_MM = 700.0
"""From the default camera to the middle of the face: a portrait's."""
_MARGIN = 1.12
_BRIGHT, _BRIGHT_PERCENTILE = 0.8, 98
"""Where automatic exposure puts which percentile of the brightest channel."""


@dataclass(frozen=True)
class Picture:
    """What a camera sees.

    Parameters
    ----------
    linear : (H, W, 3) float32
        Colour before a black background.
    alpha : (H, W) float32
        The part of each pixel that the face covers.
    """

    linear: NDArray[np.float32]
    alpha: NDArray[np.float32]

    def auto_exposure(self) -> float:
        """Return the factor that keeps the brightest parts just below white."""
        return auto_exposure(self.linear[self.alpha > 0])

    def srgb(self, exposure: float | None = None, background: float = 1.0) -> NDArray[np.uint8]:
        """Return (H, W, 3) sRGB bytes of `exposure` times the picture, by itself when None."""
        factor = self.auto_exposure() if exposure is None else exposure
        shown = np.clip(factor * self.linear, 0, self.alpha[..., None])
        return encode_srgb_bytes(shown + background * (1 - self.alpha[..., None]))


def auto_exposure(linear: ArrayLike) -> float:
    """Return the factor that puts the bright part of colours (N, 3) just below white; 1 for black ones."""
    brightest = np.asarray(linear).reshape(-1, 3).max(-1)
    bright = float(np.percentile(brightest, _BRIGHT_PERCENTILE)) if len(brightest) else 0.0
    return _BRIGHT / bright if bright > 0 else 1.0


def default_camera(
    face: ProcessedFace,
    shape: tuple[int, int] = (512, 512),
    *,
    azimuth_rad: float = 0.0,
    elevation_rad: float = 0.0,
) -> FloatArray:
    """Return the (3, 4) camera of a portrait that holds all of the face, seen from a direction.

    Parameters
    ----------
    face : ProcessedFace
    shape : (H, W)
        Of the picture.
    azimuth_rad, elevation_rad : float
        Of the camera seen from the face: from +z toward +x, and toward +y; it may not be right above.
    """
    if not abs(elevation_rad) < np.deg2rad(89):
        raise ValueError(f"elevation_rad is {elevation_rad}, expected between -89 and 89 degrees")
    low, high = face.mesh.vertices.min(0), face.mesh.vertices.max(0)
    middle, horizontal = (low + high) / 2, np.cos(elevation_rad)
    toward = np.array(
        [horizontal * np.sin(azimuth_rad), np.sin(elevation_rad), horizontal * np.cos(azimuth_rad)]
    )
    radius = 0.5 * float(np.max((high - low)[:2]))
    distance = max(DISTANCE_MM, 4 * radius)
    focal = (min(shape) - 1) / (2 * _MARGIN * radius) * (distance - (high - low)[2] / 2)
    return look_at(middle + distance * toward, middle, focal_px=focal, shape=shape)


def photograph(
    face: ProcessedFace,
    light: SceneLight,
    *,
    camera: ArrayLike | None = None,
    shape: tuple[int, int] = (512, 512),
    samples: int = 2,
    shadows: bool = True,
) -> Picture:
    """Return the picture of a face under light: every sample is shaded for its own line of sight.

    Parameters
    ----------
    face : ProcessedFace
    light : SceneLight
    camera : (3, 4) array_like of float, optional
        As in `geometry.pinhole`; `default_camera` when omitted.
    shape : (H, W)
    samples : int
        On each side of a pixel; their mean is the pixel.
    shadows : bool
        Cast shadows, beside attached ones.
    """
    given = default_camera(face, shape) if camera is None else np.asarray(camera, np.float64)
    fine = (shape[0] * samples, shape[1] * samples)
    eye, through = _rays(normalized_cameras(given[None])[0], fine, samples)
    mesh, caster = face.mesh, RayCaster(face.mesh.vertices, face.mesh.faces)
    hits = caster.first_hit(np.broadcast_to(eye, through.shape), through)
    corners = mesh.faces[hits.face]
    normal = normalized(np.einsum("nk,nkc->nc", hits.barycentric, mesh.normals[corners]))
    # A face is an open shell: its inside is nothing to see.
    seen = (hits.face >= 0) & (np.einsum("ij,ij->i", normal, through) < 0)
    corners, weight = corners[seen], hits.barycentric[seen]
    position = np.einsum("nk,nkc->nc", weight, mesh.vertices[corners])
    uv = np.einsum("nk,nkc->nc", weight, mesh.uv[corners])
    shadow_map = ShadowMap(
        RayCaster(*face.image.occluder_mesh()) if shadows else None,
        position,
        normal[seen],
        face.shadow_offset_mm,
    )
    albedo, scale = _lookup(face, uv)
    lit = shade(shadow_map, light, face.reflectance, -through[seen], scale)
    color, alpha = np.zeros((len(seen), 3)), seen.astype(np.float64)
    color[seen] = albedo * lit.diffuse + lit.specular
    return Picture(
        _pooled(color.reshape(*fine, 3), samples), _pooled(alpha.reshape(*fine, 1), samples)[..., 0]
    )


def _rays(camera: FloatArray, fine: tuple[int, int], samples: int) -> tuple[FloatArray, FloatArray]:
    """Return the eye (3,) and unit directions (N, 3) through the samples of all pixels, row by row."""
    pixels = (pixel_grid(fine) - (samples - 1) / 2) / samples
    return camera_centers(camera[None])[0], pixel_directions(camera, pixels)


def _pooled(values: FloatArray, samples: int) -> NDArray[np.float32]:
    height, width, channels = values.shape
    blocks = values.reshape(height // samples, samples, width // samples, samples, channels)
    return blocks.mean((1, 3)).astype(np.float32)


def _lookup(face: ProcessedFace, uv: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Return albedo (N, 3) and scale of highlights (N,) or None at chart coordinates, bilinearly."""
    pixels = pixels_from_uv(uv, face.image.shape)
    albedo = _bilinear(padded(face.albedo_linear, face.mask), pixels)
    given = face.image.specular_scale
    return albedo, None if given is None else _bilinear(padded(given[..., None], face.mask), pixels)[:, 0]


def padded(values: NDArray[np.floating], mask: NDArray[np.bool_]) -> FloatArray:
    """Return (H, W, C) values carried on from the nearest texel of `mask` to all others.

    Interpolation at the chart's rim must not mix in the nothing beside it.
    """
    from scipy.ndimage import distance_transform_edt

    row, column = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return values[row, column].astype(np.float64)


def _bilinear(values: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return (N, C) values (H, W, C) at pixels (N, 2), column and row."""
    limit = np.array(values.shape[1::-1]) - 1
    at = np.clip(pixels, 0, limit)
    low = np.minimum(at.astype(np.int64), np.maximum(limit - 1, 0))
    high, part = np.minimum(low + 1, limit), at - low
    column, row = part[:, :1], part[:, 1:]
    top = values[low[:, 1], low[:, 0]] * (1 - column) + values[low[:, 1], high[:, 0]] * column
    bottom = values[high[:, 1], low[:, 0]] * (1 - column) + values[high[:, 1], high[:, 0]] * column
    return np.asarray(top * (1 - row) + bottom * row)
