"""A reference renderer, written straight from the papers: rays, shading, shadows, cameras for ground truth.

It shares neither shading nor shadow code with the estimators, so that an error in one of them shows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import PointLight
from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    Float32Array,
    FloatArray,
    NDArray,
    RealArray,
    dots,
    norms,
)
from scan2albedo.errors import import_open3d
from scan2albedo.geometry.mesh import RayHits, normalized
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.io.color import encoded_srgb, srgb_to_linear


class RayScene:
    """Shoot rays at one mesh, in mm, with Open3D's `RaycastingScene` (float32: it is centred first)."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        o3d = import_open3d()
        xyz = np.asarray(vertices, float)
        self._center = (xyz.min(0) + xyz.max(0)) / 2
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        points = self._tensor((xyz - self._center).astype(np.float32))
        self._scene.add_triangles(points, self._tensor(np.ascontiguousarray(faces, np.uint32)))

    def _rays(self, origins: ArrayLike, directions: ArrayLike):  # type: ignore[no-untyped-def]
        start = np.asarray(origins, float) - self._center
        heading = np.broadcast_to(np.asarray(directions, float), start.shape)
        return self._tensor(np.concatenate([start, heading], 1).astype(np.float32))

    def first_hit(self, origins: ArrayLike, directions: ArrayLike) -> RayHits:
        """Return the first hit of each ray from `origins` (N, 3) along unit `directions` (N, 3)."""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        distance = answer["t_hit"].numpy().astype(float)
        face = answer["primitive_ids"].numpy().astype(int)
        u, v = answer["primitive_uvs"].numpy().astype(float).T
        face[~np.isfinite(distance)] = -1
        barycentric = np.stack([1 - u - v, u, v], 1)
        barycentric[face < 0] = 0
        return RayHits(face, barycentric, distance)

    def occluded(self, origins: ArrayLike, directions: ArrayLike, reach: ArrayLike = np.inf) -> BoolArray:
        """Return (N,) True where the ray hits the mesh nearer than `reach` ((N,) or scalar, mm)."""
        rays, limit = self._rays(origins, directions), np.asarray(reach, float)
        if limit.ndim == 0:
            return self._scene.test_occlusions(rays, 0.0, float(limit)).numpy().astype(bool)
        return self._scene.cast_rays(rays)["t_hit"].numpy() < limit

    def hidden(self, eye: FloatArray, points: FloatArray, behind_mm: float) -> BoolArray:
        """Return (N,) True for points (N, 3) more than `behind_mm` behind what `eye` (3,) sees."""
        distance = norms(points - eye)
        toward = (points - eye) / distance[:, None]
        return self.occluded(np.broadcast_to(eye, points.shape), toward, distance - behind_mm)


_GRAZING_RAD = np.deg2rad(89.99)
SHADOW_OFFSET_MM = 0.15
"""Start of shadow rays above the surface: rays are float32."""


@dataclass(frozen=True)
class Material:
    """How a surface reflects, apart from its albedo."""

    sigma_rad: float = 0.3
    """Oren-Nayar roughness: standard deviation of the facets' slope angle; 0 is Lambert."""
    specular_strength: float = 0.0
    """Phong's k_s, relative to an albedo of 1; 0 is not a highlight."""
    specular_exponent: float = 20.0
    """Phong's n."""


@dataclass(frozen=True)
class Rendered:
    """A rendering of N surface points under ambient light 1: ``radiance = albedo * shading + specular``.

    `radiance_linear` (N, 3); `shading` (N,), 1 + the lights' diffuse shading with shadows; `specular` (N,),
    the same in all channels; `visible` (N, L), whether the point faces light l and nothing hides it.
    """

    radiance_linear: FloatArray
    shading: FloatArray
    specular: FloatArray
    visible: BoolArray


def render(
    position: ArrayLike,
    normal: ArrayLike,
    albedo_linear: ArrayLike,
    lights: Sequence[PointLight],
    *,
    material: Material,
    occluder: RayScene | None = None,
    view_direction: ArrayLike = (0.0, 0.0, 1.0),
    specular_scale: ArrayLike = 1.0,
) -> Rendered:
    """Shade surface points (N, 3) in mm, the model's frame, under ambient light 1 and `lights`.

    ``T = A (1 + sum_l s_l E_l D_l) + sum_l s_l E_l S_l`` with albedo A, shadow s in {0, 1}, irradiance factor
    E = intensity (distance / r)^2, Oren-Nayar's D and Phong's S. Without `occluder` nothing casts shadows.
    Unit vectors `view_direction`, (3,) or (N, 3), point toward the viewer; `specular_scale`, a float or (N,),
    multiplies the highlights.
    """
    xyz, n = np.asarray(position, float), np.asarray(normal, float)
    v = np.broadcast_to(np.asarray(view_direction, float), xyz.shape)
    shading, specular = np.ones(len(xyz)), np.zeros(len(xyz))
    visible = np.zeros((len(xyz), len(lights)), bool)
    for column, light in enumerate(lights):
        toward, reach, irradiance = incident_light(xyz, light)
        reached = dots(n, toward) > 0
        if occluder is not None:
            start = xyz[reached] + SHADOW_OFFSET_MM * n[reached]
            reached[reached] = ~occluder.occluded(
                start, toward[reached], reach[reached] if np.isfinite(reach[0]) else np.inf
            )
        visible[:, column] = reached
        arriving = irradiance * reached
        shading += arriving * oren_nayar(n, toward, v, material.sigma_rad)
        specular += arriving * material.specular_strength * phong(n, toward, v, material.specular_exponent)
    specular = specular * np.asarray(specular_scale, float)
    radiance = np.asarray(albedo_linear, float) * shading[:, None] + specular[:, None]
    return Rendered(radiance, shading, specular, visible)


def incident_light(position: FloatArray, light: PointLight) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return unit directions toward the light (N, 3), distances to it (N,) mm, irradiance factors (N,)."""
    if np.isinf(light.distance_mm):
        count = len(position)
        intensity = np.full(count, float(light.intensity))
        return np.tile(light.direction, (count, 1)), np.full(count, np.inf), intensity
    offset = light.distance_mm * light.direction - position
    reach = norms(offset)
    return offset / reach[:, None], reach, light.intensity * (light.distance_mm / reach) ** 2


def oren_nayar(
    normal: FloatArray, toward_light: FloatArray, toward_viewer: FloatArray, sigma_rad: float
) -> FloatArray:
    """Return (N,) cos(theta_i) (A + B max(0, cos(phi_r - phi_i)) sin(alpha) tan(beta)).

    ``A = 1 - 0.5 s^2 / (s^2 + 0.33)``, ``B = 0.45 s^2 / (s^2 + 0.09)``, alpha and beta the larger and
    the smaller of theta_i and theta_r (Oren, Nayar, "Generalization of Lambert's Reflectance Model", SIGGRAPH
    1994, eq. 30). Angles are computed one by one; a viewer below the horizon counts as at the horizon.
    """
    # The tangent is across the coordinate axis that each normal leans on least.
    tangent = normalized(np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)]))
    bitangent = np.cross(normal, tangent)

    def polar(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
        along = [dots(direction, axis) for axis in (tangent, bitangent, normal)]
        theta = np.arctan2(np.hypot(along[0], along[1]), along[2])
        return np.minimum(theta, _GRAZING_RAD), np.arctan2(along[1], along[0])

    theta_i, phi_i = polar(toward_light)
    theta_r, phi_r = polar(toward_viewer)
    alpha, beta = np.maximum(theta_i, theta_r), np.minimum(theta_i, theta_r)
    variance = sigma_rad**2
    a, b = 1 - variance / 2 / (variance + 0.33), 0.45 * variance / (variance + 0.09)
    facets = b * np.maximum(0, np.cos(phi_r - phi_i)) * np.sin(alpha) * np.tan(beta)
    return np.cos(theta_i) * (a + facets)


def phong(
    normal: FloatArray, toward_light: FloatArray, toward_viewer: FloatArray, exponent: float
) -> FloatArray:
    """Return (N,) max(0, r . v)^exponent, r the mirrored light direction (Phong, CACM 18(6), 1975)."""
    mirrored = 2 * dots(normal, toward_light)[:, None] * normal - toward_light
    return np.maximum(0, dots(mirrored, toward_viewer)) ** exponent


TARGET_MM = np.array([0.0, 0.0, -5.0])
"""Point of the head in the middle of portraits."""


def auto_exposure(radiance_linear: ArrayLike) -> float:
    """Return the factor that puts the brightest value of the picture just below white."""
    brightest = float(np.max(radiance_linear))
    return 0.98 / brightest if brightest > 0 else 1.0


def photograph(
    radiance_linear: ArrayLike, *, exposure: float, noise: float, bits: int | None, rng: np.random.Generator
) -> Float32Array:
    """Return the linear picture decoded from what the camera stored of radiance of any shape.

    The sensor sees `exposure` times the radiance, 1 being white, with Gaussian noise of standard deviation
    `noise`. The sRGB-encoded picture is rounded to 2^bits levels; None leaves it unrounded, but clipped.
    """
    sensor = np.asarray(radiance_linear, np.float32) * np.float32(exposure)
    if noise > 0:
        sensor += np.float32(noise) * rng.standard_normal(sensor.shape, dtype=np.float32)
    sensor = np.clip(sensor, 0, 1)
    if bits is None:
        return sensor
    levels = 2**bits - 1
    # In float32, as the picture is: half the memory, and the same bits as ever.
    stored = np.round(encoded_srgb(sensor) * levels).astype(int)
    return srgb_to_linear(np.arange(levels + 1) / levels).astype(np.float32)[stored]


def toward(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Return the unit vector (3,) from the head: azimuth from +z toward +x, elevation toward +y."""
    return PointLight(math.radians(azimuth_deg), math.radians(elevation_deg)).direction


@dataclass(frozen=True, kw_only=True)
class Portrait:
    """A camera before a person; ValueError for a value outside its range."""

    picture_size: int = 256
    """Height and width in pixels."""
    reach_mm: float = 130.0
    """Half of what a picture spans at the head."""
    distance_mm: float = 1000.0
    """Of the camera from the head."""
    gamma: float = 1.2
    """Values are light^(1 / gamma)."""
    noise: float = 0.01
    """Standard deviation of the values, white = 1."""
    bits: int | None = 8
    """8, 16, or None for values that are neither rounded nor clipped."""
    saturated_part: float = 0.002
    """Part of the face's pixels in all pictures that is brighter than white."""

    def __post_init__(self) -> None:
        refuse_outside(1, picture_size=self.picture_size)
        refuse_outside(0, noise=self.noise)
        for name in ("reach_mm", "distance_mm", "gamma"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected > 0 and finite")
        if not 0 <= self.saturated_part < 1:
            raise ValueError(f"saturated_part is {self.saturated_part}, expected in [0, 1)")
        if self.bits not in (8, 16, None):
            raise ValueError(f"bits is {self.bits}, expected 8, 16 or None")

    @property
    def focal_px(self) -> float:
        """Focal length."""
        return self.picture_size * self.distance_mm / (2 * self.reach_mm)

    def camera(self, azimuth_deg: float, elevation_deg: float) -> FloatArray:
        """Return the (3, 4) camera that looks at the head from a direction."""
        position = TARGET_MM + self.distance_mm * toward(azimuth_deg, elevation_deg)
        shape = (self.picture_size, self.picture_size)
        return look_at(position, TARGET_MM, focal_px=self.focal_px, shape=shape)

    def exposure(self, brightest: FloatArray) -> float:
        """Return the factor that saturates `saturated_part` of the face's pixels; 1 for black pictures."""
        white = float(np.quantile(brightest, 1 - self.saturated_part)) if len(brightest) else 0.0
        return 1 / white if white > 0 else 1.0

    def stored(self, linear: RealArray, rng: np.random.Generator) -> NDArray:
        """Return the values that the camera stores of light (H, W, 3), white = 1, with its noise."""
        values = linear ** np.float32(1 / self.gamma)
        values += np.float32(self.noise) * rng.standard_normal(values.shape, dtype=np.float32)
        if self.bits is None:
            return values
        kind = np.uint8 if self.bits == 8 else np.uint16
        return np.round(np.clip(values, 0, 1) * np.iinfo(kind).max).astype(kind)


def refuse_outside(least: int, **values: float) -> None:
    """Raise ValueError unless all values are finite and `least` or more."""
    for name, value in values.items():
        if not least <= value < math.inf:
            raise ValueError(f"{name} is {value}, expected >= {least} and finite")
