"""Surfaces that lenses show and mirror: one ray caster over all of them, and what a ray finds on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.checks import checked_mesh
from scan2albedo.eyeglasses.lenses.light_kernels import seen_normals
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.geometry.rays import RayCaster, RayHits

_SMOOTH = 0.3
"""Cosine to its face below which a smoothed normal is replaced by the face's: its neighbours are wound in two
ways."""


@dataclass(frozen=True)
class Surface:
    """A mesh with its colour, in mm in the world's frame.

    Raises EyeglassesError when there are no faces or numbers are not finite; ValueError when an array has the
    wrong shape, or the texture comes without `uv`.
    """

    vertices: ArrayLike
    """(V, 3)."""
    faces: ArrayLike
    """(F, 3) of any winding; both sides are seen."""
    albedo_linear: ArrayLike = (0.5, 0.5, 0.5)
    """(3,) or (V, 3); ignored where there is a texture."""
    uv: ArrayLike | None = None
    """(V, 2) of vertices or (F, 3, 2) of each face's corners; v = 0 is the bottom row."""
    texture_linear: ArrayLike | None = None
    """(H, W, 3) albedo; needs `uv`."""
    roughness_rad: float = 0.0
    """Oren and Nayar's sigma; 0 is Lambert."""
    specular: float = 0.0
    shininess: float = 32.0
    """`specular` and `shininess` are strength and exponent of Phong's highlight, as in `lighting.kernels`."""

    def __post_init__(self) -> None:
        xyz, index = checked_mesh(self.vertices, self.faces, "a surface")
        albedo = np.asarray(self.albedo_linear, np.float64)
        albedo = _checked("albedo_linear", albedo, (3,) if albedo.ndim == 1 else (len(xyz), 3))
        fields = {"vertices": xyz, "faces": index, "albedo_linear": albedo}
        if self.texture_linear is not None:
            if self.uv is None:
                raise ValueError("a texture needs uv")
            # Pictures of floats stay in 32 bits: twice as much is a lot for a large one.
            texture = np.asarray(self.texture_linear)
            single = texture.dtype == np.float32
            fields["texture_linear"] = _checked(
                "texture_linear", texture, (None, None, 3), np.float32 if single else np.float64
            )
            uv = np.asarray(self.uv, np.float64)
            shape = (len(xyz), 2) if uv.ndim == 2 else (len(index), 3, 2)
            fields["uv"] = _checked("uv", uv, shape)
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def albedo(self, face: IntArray, barycentric: FloatArray) -> FloatArray:
        """Return (N, 3) linear albedo at points of this surface."""
        if self.texture_linear is not None:
            uv = np.asarray(self.uv)
            corners = uv[face] if uv.ndim == 3 else uv[np.asarray(self.faces)[face]]
            texture = np.asarray(self.texture_linear)
            at = np.einsum("nk,nkc->nc", barycentric, corners)
            return bilinear(texture, pixels_from_uv(at, texture.shape[:2]))
        albedo = np.asarray(self.albedo_linear)
        if albedo.ndim == 1:
            return np.broadcast_to(albedo, (len(face), 3))
        return np.asarray(np.einsum("nk,nkc->nc", barycentric, albedo[np.asarray(self.faces)[face]]))


@dataclass(frozen=True)
class SeenPoints:
    """Points of the scene that rays found; N rays, all of which hit."""

    face: IntArray
    """(N,) of the joined mesh."""
    barycentric: FloatArray
    """(N, 3)."""
    position: FloatArray
    """(N, 3) mm."""
    normal: FloatArray
    """(N, 3) unit, smooth, on the side of the viewer."""
    toward_viewer: FloatArray
    """(N, 3) unit, back along the ray."""
    distance: FloatArray
    """(N,) mm along the ray."""
    surface: IntArray
    """(N,) number of the surface: 0 is the frame, then the others in their order."""


class LensScene:
    """The frame and the surfaces around it as one mesh."""

    def __init__(self, frame: Surface, surfaces: Sequence[Surface]) -> None:
        self.surfaces = (frame, *surfaces)
        counts = [len(np.asarray(s.vertices)) for s in self.surfaces]
        starts = np.cumsum([0, *counts[:-1]])
        self.vertices = np.concatenate([np.asarray(s.vertices) for s in self.surfaces])
        self.faces = np.concatenate(
            [np.asarray(s.faces) + start for s, start in zip(self.surfaces, starts, strict=True)]
        )
        face_counts = [len(np.asarray(s.faces)) for s in self.surfaces]
        self.face_starts = np.cumsum([0, *face_counts[:-1]])
        self.surface_of_face = np.repeat(np.arange(len(self.surfaces)), face_counts)
        self.caster = RayCaster(self.vertices, self.faces)

    @cached_property
    def _normals(self) -> FloatArray:
        return vertex_normals(self.vertices, self.faces)

    def points(self, origins: FloatArray, directions: FloatArray, hits: RayHits) -> SeenPoints:
        """Return what rays (N, 3) found that all hit."""
        normal = seen_normals(
            directions, hits.face, hits.barycentric, self.vertices, self.faces, self._normals, _SMOOTH
        )
        return SeenPoints(
            hits.face,
            hits.barycentric,
            origins + directions * hits.distance[:, None],
            normal,
            -directions,
            hits.distance,
            self.surface_of_face[hits.face],
        )

    def albedo(self, points: SeenPoints) -> FloatArray:
        """Return (N, 3) linear albedo."""
        albedo = np.empty((len(points.face), 3))
        for number, surface in enumerate(self.surfaces):
            own = points.surface == number
            if own.any():
                local = points.face[own] - self.face_starts[number]
                albedo[own] = surface.albedo(local, points.barycentric[own])
        return albedo


def _checked(
    name: str, values: ArrayLike, shape: tuple[int | None, ...], dtype: type[np.floating] = np.float64
) -> FloatArray:
    array: FloatArray = np.asarray(values, dtype)
    fits = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = str(shape).replace("None", "N")
        raise ValueError(f"{name} must have shape {wanted}, got {array.shape}")
    if not np.isfinite(array).all():
        raise EyeglassesError(f"a surface's {name} hold numbers that are not finite; repair the input first")
    return array
