"""Surfaces that lenses show and mirror: one ray caster over all of them, and what a ray finds on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    RealArray,
    all_finite,
    dots,
    norms,
    smoothstep,
)
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import checked_mesh
from scan2albedo.geometry.mesh import RayHits, face_cross_products, join, normalized, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import texel_directions, texel_solid_angles

_SMOOTH = 0.3
"""Cosine to its face below which a smoothed normal is replaced by the face's: winding differs around it."""
_LAMPS = (((-0.6, 0.6, 0.7), 0.82, 7.0), ((0.9, 0.15, 0.6), 0.86, 1.6), ((0.15, 0.95, -0.45), 0.86, 3.0))
"""Direction (to the wearer's left, up, to the front), cosine of half the angle and radiance of each soft
lamp: key, fill, and one above the sitter."""
_SOFTNESS = 0.08
"""Cosines over which a lamp's edge fades."""
WHITE_SHOWN = 0.9
"""Part of a preview's white as which a white plate that faces as the frame does is shown."""


@dataclass(frozen=True)
class Surface:
    """A mesh with its colour, in mm in the world's frame.

    Raises EyeglassesError when there are no faces or numbers are not finite; ValueError for a wrong shape.
    """

    vertices: FloatArray
    faces: IntArray
    """(F, 3) over `vertices` (V, 3), of any winding where both sides are seen."""
    albedo_linear: ArrayLike = (0.5, 0.5, 0.5)
    """(3,) or (V, 3); ignored where there is a texture."""
    uv: FloatArray | None = None
    texture_linear: RealArray | None = None
    """(H, W, 3) albedo; needs `uv`, (V, 2) or (F, 3, 2) of each face's corners; v = 0 is the bottom row."""
    roughness_rad: float = 0.0
    """Oren and Nayar's sigma; 0 is Lambert."""
    specular: float = 0.0
    shininess: float = 32.0
    """`specular` and `shininess` are strength and exponent of Phong's highlight, as in `lighting.shading`."""
    one_sided: bool = False
    """Whether rays see only the side to which the faces run counterclockwise; both cast shadows."""

    def __post_init__(self) -> None:
        xyz, index = checked_mesh(self.vertices, self.faces, "a surface")
        albedo = np.asarray(self.albedo_linear, float)
        fields = {"vertices": xyz, "faces": index, "albedo_linear": albedo}
        shapes: dict[str, tuple[int, ...]] = {"albedo_linear": (3,) if albedo.ndim == 1 else (len(xyz), 3)}
        if self.texture_linear is not None:
            if self.uv is None:
                raise ValueError("a texture needs uv")
            # Pictures of floats stay in 32 bits: twice as much is a lot for a large one.
            texture, uv = np.asarray(self.texture_linear), np.asarray(self.uv, float)
            fields["texture_linear"] = texture if texture.dtype == np.float32 else texture.astype(float)
            fields["uv"] = uv
            shapes["texture_linear"] = (*texture.shape[:2], 3)
            shapes["uv"] = (len(xyz), 2) if uv.ndim == 2 else (len(index), 3, 2)
        for name, shape in shapes.items():
            if fields[name].shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {fields[name].shape}")
            if not all_finite(fields[name]):
                raise EyeglassesError(f"a surface's {name} are not finite; repair the input first")
        vars(self).update(fields)


@dataclass(frozen=True)
class SceneRays:
    """N rays from `origins` (N, 3) mm along unit `directions` (N, 3), and where they end in the scene.

    `pixels` (N, 2) are those through which they are seen, if any.
    """

    origins: FloatArray
    directions: FloatArray
    hits: RayHits
    pixels: FloatArray | None = None

    def chosen(self, which: IntArray | BoolArray) -> SceneRays:
        """Return copies of some of the rays."""
        hits = RayHits(self.hits.face[which], self.hits.barycentric[which], self.hits.distance[which])
        pixels = None if self.pixels is None else self.pixels[which]
        return SceneRays(self.origins[which], self.directions[which], hits, pixels)

    @property
    def ends(self) -> FloatArray:
        """(N, 3) where they meet a surface; not finite for the others."""
        return self.origins + self.directions * self.hits.distance[:, None]


class LensScene:
    """The frame and the surfaces around it as one mesh; `surface_of_face` (F,) is 0 for the frame."""

    def __init__(self, frame: Surface, surfaces: Sequence[Surface]) -> None:
        self.surfaces = (frame, *surfaces)
        meshes = [(surface.vertices, surface.faces) for surface in self.surfaces]
        self.vertices, self.faces = join(meshes)
        counts = [len(faces) for _, faces in meshes]
        self._face_starts = np.cumsum([0, *counts])
        self.surface_of_face = np.repeat(np.arange(len(meshes)), counts)
        self.caster = RayCaster(self.vertices, self.faces)
        self._normals = vertex_normals(self.vertices, self.faces)
        self._one_sided = np.repeat([surface.one_sided for surface in self.surfaces], counts)

    def rays(
        self, origins: FloatArray, directions: FloatArray, pixels: FloatArray | None = None
    ) -> SceneRays:
        """Return rays from origins, (3,) or (N, 3), along unit directions (N, 3)."""
        start = np.broadcast_to(origins, directions.shape)
        return SceneRays(start, directions, self.first_hit(start, directions), pixels)

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> RayHits:
        """Return where rays (N, 3) end; the back of a one-sided surface ends none, nor what is behind it."""
        hits = self.caster.first_hit(origins, directions)
        at = np.flatnonzero((hits.face >= 0) & self._one_sided[hits.face])
        front = face_cross_products(self.vertices, self.faces[hits.face[at]])
        back = at[dots(front, directions[at]) > 0]
        hits.face[back], hits.distance[back] = -1, np.inf
        return hits

    def normals(self, rays: SceneRays) -> FloatArray:
        """Return (N, 3) unit normals, smooth, on the side of the viewer, where rays that all hit end."""
        corners = self.faces[rays.hits.face]
        flat = face_cross_products(self.vertices, corners)
        smooth = np.einsum("nk,nkc->nc", rays.hits.barycentric, self._normals[corners])
        agreement = dots(flat, smooth)
        size = norms(flat) * norms(smooth)
        believed = np.abs(agreement) > _SMOOTH * size
        normal = normalized(np.where(believed[:, None], np.sign(agreement)[:, None] * smooth, flat))
        return np.where((dots(flat, rays.directions) > 0)[:, None], -normal, normal)

    def albedo(self, rays: SceneRays) -> FloatArray:
        """Return (N, 3) linear albedo where rays that all hit end."""
        albedo = np.empty((len(rays.origins), 3))
        for number, surface in enumerate(self.surfaces):
            own = np.flatnonzero(self.surface_of_face[rays.hits.face] == number)
            weight, face = rays.hits.barycentric[own], rays.hits.face[own] - self._face_starts[number]
            corners = surface.faces[face]
            uv, texture = surface.uv, surface.texture_linear
            if uv is not None and texture is not None:
                at = np.einsum("nk,nkc->nc", weight, uv[face] if uv.ndim == 3 else uv[corners])
                albedo[own] = bilinear(texture, pixels_from_uv(at, texture.shape[:2]))
            elif (color := np.asarray(surface.albedo_linear)).ndim == 1:
                albedo[own] = color
            else:
                albedo[own] = np.einsum("nk,nkc->nc", weight, color[corners])
        return albedo


def radiance_at(environment_linear: FloatArray | None, directions: FloatArray) -> FloatArray:
    """Return (N, 3) radiance of an environment map (H, W, 3) from directions (N, 3), bilinear; None is black.

    Rows run from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x.
    """
    if environment_linear is None:
        return np.zeros((len(directions), 3))
    height, width = environment_linear.shape[:2]
    x, y, z = directions.T
    # The angle from +y by its tangent: a cosine near 1 hardly changes with it.
    polar = np.arctan2(np.sqrt(x * x + z * z), y)
    column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width - 0.5
    around = np.pad(environment_linear, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    return bilinear(around, np.stack([column + 1, polar / np.pi * height - 0.5], 1))


def soft_environment(axes: ArrayLike, *, rows: int = 128) -> FloatArray:
    """Return a neutral map (rows, 2 rows, 3): an even room, brighter above, with three soft lamps.

    `axes` (3, 3) are those of `own_axes`: lamps stand around the wearer, the main one on their right.
    """
    seen = texel_directions((rows, 2 * rows)) @ np.asarray(axes, float).T
    radiance = 0.4 + 0.2 * seen[..., 1]
    for direction, edge, strength in _LAMPS:
        rise = smoothstep((seen @ normalized(np.array(direction)) - edge) / _SOFTNESS + 0.5)
        radiance = radiance + strength * rise
    return np.repeat(radiance[..., None], 3, 2)


def white_exposure(environment_linear: FloatArray, front: FloatArray) -> float:
    """Return the factor that shows a matte white plate facing `front` (3,) as `WHITE_SHOWN` of white.

    It gets at least what a plate of any direction gets on average from the environment; 1 in the dark.
    """
    rows, columns = environment_linear.shape[:2]
    light = environment_linear.mean(2) * texel_solid_angles(rows, columns)[:, None]
    facing = np.maximum(texel_directions((rows, columns)) @ front, 0.0)
    radiance = max((light * facing).sum(), light.sum() / 4) / np.pi
    return WHITE_SHOWN / radiance if radiance > 0 else 1.0
