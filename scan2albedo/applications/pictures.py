"""Pictures of a processed face from a camera, lit pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.applications.processed_face import FaceMesh, ProcessedFace
from scan2albedo.applications.scene_light import SceneLight, shade
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import (
    camera_centers,
    look_at,
    normalized_cameras,
    pixel_directions,
    project,
)
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.lighting.shadow_map import ShadowMap

DISTANCE_MM = 700.0
"""From the default camera to the middle of the face: a portrait's."""
PORTRAIT_MARGIN = 1.12
"""The default picture's width as a multiple of the face's."""
_TESSELLATION = 0.75
"""Between flat triangles, 0, and the mean of the tangent planes at their corners, 1."""
_BRIGHT, _BRIGHT_PERCENTILE = 0.8, 98
"""Automatic exposure shows this percentile of the brightest channel at this linear level."""


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

    def srgb(self, exposure: float | None = None, background: float = 1.0) -> NDArray[np.uint8]:
        """Return (H, W, 3) sRGB bytes of `exposure` times the picture, by itself when None.

        ValueError for an exposure that is not finite and above 0.
        """
        factor = self.auto_exposure() if exposure is None else checked_exposure(exposure)
        shown = np.clip(factor * self.linear, 0, self.alpha[..., None])
        return encode_srgb_bytes(shown + background * (1 - self.alpha[..., None]))


def auto_exposure(linear: ArrayLike) -> float:
    """Return the factor that puts the bright part of colours (N, 3) just below white; 1 for black ones."""
    brightest = np.asarray(linear).reshape(-1, 3).max(-1)
    bright = float(np.percentile(brightest, _BRIGHT_PERCENTILE)) if len(brightest) else 0.0
    return _BRIGHT / bright if bright > 0 else 1.0


def checked_exposure(exposure: float) -> float:
    """Return an exposure that is finite and above 0; others raise ValueError."""
    if not (np.isfinite(exposure) and exposure > 0):
        raise ValueError(f"exposure is {exposure}, expected a finite number above 0")
    return exposure


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
        Of the camera seen from the face: from +z toward +x, and toward +y, not right above.

    Raises
    ------
    ValueError
        For an azimuth that is not finite, an elevation beyond 89 degrees, or a shape below 2 pixels.
    """
    if not abs(elevation_rad) < np.deg2rad(89):
        raise ValueError(f"elevation_rad is {elevation_rad}, expected between -89 and 89 degrees")
    if not np.isfinite(azimuth_rad) or min(shape) < 2:
        raise ValueError(
            f"azimuth_rad is {azimuth_rad} and shape {shape}, expected a finite angle and 2 pixels or more"
        )
    middle, radius, depth = portrait_frame(face.mesh.vertices)
    horizontal = np.cos(elevation_rad)
    toward = np.array(
        [horizontal * np.sin(azimuth_rad), np.sin(elevation_rad), horizontal * np.cos(azimuth_rad)]
    )
    distance = max(DISTANCE_MM, 4 * radius)
    focal = (min(shape) - 1) / (2 * PORTRAIT_MARGIN * radius) * (distance - depth / 2)
    return look_at(middle + distance * toward, middle, focal_px=focal, shape=shape)


def portrait_frame(vertices: FloatArray) -> tuple[FloatArray, float, float]:
    """Return the middle (3,) of vertices (V, 3), half their greater width or height, and their depth."""
    low, high = vertices.min(0), vertices.max(0)
    return (low + high) / 2, 0.5 * float(np.max((high - low)[:2])), float((high - low)[2])


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

    `camera` (3, 4) is as in `geometry.pinhole`, `default_camera` when None. A pixel is the mean of `samples`
    by `samples`. Without `shadows` only attached shadows are left. ValueError for an invalid camera, a shape
    below 2 pixels, or no sample.
    """
    if min(shape) < 2 or samples < 1:
        raise ValueError(f"shape is {shape} and samples {samples}, expected 2 pixels and 1 sample or more")
    given = default_camera(face, shape) if camera is None else np.asarray(camera, np.float64)
    projection, fine = normalized_cameras(given[None])[0], (shape[0] * samples, shape[1] * samples)
    mesh = face.mesh
    sample, corners, weight, through = _visible_samples(mesh, projection, fine, samples)
    position = _curved(mesh, corners, weight)
    normal = normalized(np.einsum("nk,nkc->nc", weight, mesh.normals[corners]))
    occluder = RayCaster(*face.image.occluder_mesh()) if shadows else None
    shadow_map = ShadowMap(occluder, position, normal, face.shadow_offset_mm)
    albedo, scale = _lookup(face, np.einsum("nk,nkc->nc", weight, mesh.uv[corners]))
    lit = shade(shadow_map, light, face.reflectance, -through, scale)
    color = np.zeros((fine[0] * fine[1], 4))
    color[sample, :3], color[sample, 3] = albedo * lit.diffuse + lit.specular, 1.0
    pooled = _pooled(color.reshape(*fine, 4), samples)
    return Picture(pooled[..., :3], pooled[..., 3])


def _curved(mesh: FaceMesh, corners: IntArray, weight: FloatArray) -> FloatArray:
    """Return (N, 3) the points of a mesh at barycentric coordinates (N, 3) of triangles (N, 3).

    The triangles between texels of a chart's mesh are below the curved surface, and its finer occluder would
    shade them: their points are lifted by the normals at their corners (Boubekeur, Alexa, "Phong
    tessellation", ACM Transactions on Graphics 27(5), 2008).
    """
    vertices = mesh.vertices[corners]
    flat = np.asarray(np.einsum("nk,nkc->nc", weight, vertices))
    if not mesh.from_chart:
        return flat
    normals = mesh.normals[corners]
    below = np.einsum("nkc,nkc->nk", vertices - flat[:, None], normals)
    return flat + _TESSELLATION * np.einsum("nk,nk,nkc->nc", weight, below, normals)


def _visible_samples(
    mesh: FaceMesh, camera: FloatArray, fine: tuple[int, int], samples: int
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return the N of the samples `fine` (H, W) that show the outside of the face.

    Their index (N,) row by row, the vertices (N, 3) of the triangle seen, barycentric coordinates (N, 3) and
    the unit direction of sight (N, 3).
    """
    row, column = _window(mesh, camera, fine, samples)
    index = (row[:, None] * fine[1] + column).ravel()
    pixels = np.stack(np.broadcast_arrays(column[None], row[:, None]), -1).reshape(-1, 2)
    through = pixel_directions(camera, (pixels - (samples - 1) / 2) / samples)
    eye = camera_centers(camera[None])[0]
    hits = RayCaster(mesh.vertices, mesh.faces).first_hit(np.broadcast_to(eye, through.shape), through)
    seen = np.flatnonzero(hits.face >= 0)
    corners, weight, sight = mesh.faces[hits.face[seen]], hits.barycentric[seen], through[seen]
    normal = np.einsum("nk,nkc->nc", weight, mesh.normals[corners])
    outside = np.einsum("ij,ij->i", normal, sight) < 0
    return index[seen[outside]], corners[outside], weight[outside], sight[outside]


def _window(
    mesh: FaceMesh, camera: FloatArray, fine: tuple[int, int], samples: int
) -> tuple[IntArray, IntArray]:
    """Return rows and columns of samples that the mesh can cover; all when part of it is behind the eye."""
    pixels, depth = project(camera, mesh.vertices)
    if not (depth > 0).all():
        return np.arange(fine[0]), np.arange(fine[1])
    low = np.clip(np.floor(pixels.min(0) * samples - 1), 0, fine[::-1]).astype(np.int64)
    high = np.clip(np.ceil(pixels.max(0) * samples + samples + 1), 0, fine[::-1]).astype(np.int64)
    return np.arange(low[1], high[1]), np.arange(low[0], high[0])


def _pooled(values: FloatArray, samples: int) -> NDArray[np.float32]:
    height, width, channels = values.shape
    blocks = values.reshape(height // samples, samples, width // samples, samples, channels)
    return blocks.mean((1, 3)).astype(np.float32)


def _lookup(face: ProcessedFace, uv: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Return albedo (N, 3) and scale of highlights (N,) or None at chart coordinates, bilinearly."""
    pixels = pixels_from_uv(uv, face.image.shape)
    albedo = bilinear(filled_from_nearest(face.albedo_linear, face.mask), pixels)
    given = face.image.specular_scale
    return albedo, None if given is None else bilinear(
        filled_from_nearest(given[..., None], face.mask), pixels
    )[:, 0]
