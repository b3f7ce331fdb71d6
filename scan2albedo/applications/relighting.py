"""`relight`: a processed face under other light, on its chart and in pictures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.ndimage import gaussian_filter

from scan2albedo.core import EnvironmentLight, PointLight
from scan2albedo.core.arguments import require_linear, require_type
from scan2albedo.core.arrays import (
    ArrayLike,
    Float32Array,
    FloatArray,
    GridShape,
    Texts,
    dots,
    norms,
    on_grid,
)
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.mesh import join, lengths, normalized, vertex_normals
from scan2albedo.geometry.pinhole import camera_centers, look_at, normalized_cameras
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.glb import GlbPart, write_glb
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.rendering import pictures
from scan2albedo.rendering.pictures import (
    Picture,
    SeenSamples,
    auto_exposure,
    checked_exposure,
    seen_samples,
)
from scan2albedo.rendering.scene_light import LitSurface, SceneLight, shade
from scan2albedo.unlit.eyes import WET_EXPONENT, WET_REFLECTANCE
from scan2albedo.unlit.eyes_and_mouth import eyes_and_mouth
from scan2albedo.unlit.face_features import AROUND, feature_texels, without_gaps
from scan2albedo.unlit.processed_face import NO_MODEL, ProcessedFace

Gloss = Literal["auto", "found", "none"]

SKIN_GLOSS = 0.25
"""Usual highlight of skin as a part of its albedo's level. A dielectric of index 1.4 reflects F = 0.028, and
Beckmann's lobe of slope m = 0.2 peaks at pi F / (4 pi m^2) = 0.17 of a white surface; skin's albedo is 0.5 to
0.7."""
SKIN_EXPONENT = 12.0
"""Phong's, 1 / (2 m^2), whose lobe follows that of slope m."""
_DENT_MM = 3.5
"""How far the dents that scans have at eyes go into an eyeball at most."""


@dataclass(frozen=True)
class RelightOptions:
    """Settings of `relight`."""

    gloss: Gloss = "auto"
    """"found" is the highlight of the estimate, "none" leaves it off; "auto" gives a face fitted with a model
    skin's usual highlight where the estimate found none."""
    fill_gaps: bool = True
    """Put smooth skin where none was seen, and on hair before the ears, which is a black patch else."""

    def __post_init__(self) -> None:
        if self.gloss not in get_args(Gloss):
            raise ValueError(f"gloss is {self.gloss!r}, expected one of {get_args(Gloss)}")


@dataclass(frozen=True)
class RelitFace:
    """A face under light, which is computed where it is asked for: on the chart, or in a picture.

    Both raise ApplicationError for what is brighter than single precision holds.
    """

    face: ProcessedFace
    light: SceneLight
    """`face`, `light`: what is lit, with its gloss and without gaps, and by what."""
    notes: Texts = ()
    """What was assumed or filled, for people."""

    @cached_property
    def _on_chart(self) -> list[Float32Array]:
        """Texture, diffuse and specular light (H, W, 3)."""
        face, image, mask = self.face, self.face.image, self.face.mask
        caster = RayCaster(*image.occluder_mesh()) if face.casts_shadows and self.light.casts else None
        shadows = ShadowMap(caster, image.position[mask], image.normal[mask], face.shadow_offset_mm)
        scale = None if image.specular_scale is None else image.specular_scale[mask].astype(float)
        view = normalized(np.asarray(face.view_direction, float))
        diffuse, specular = shade(shadows, self.light, face.reflectance, view, scale)
        texture = face.albedo_linear[mask].astype(float) * diffuse + specular
        return [on_grid(mask, _checked(face, values)) for values in (texture, diffuse, specular)]

    @property
    def texture_linear(self) -> Float32Array:
        """(H, W, 3): albedo times `diffuse`, plus `specular`; 0 outside the mask, not clipped."""
        return self._on_chart[0]

    @property
    def diffuse(self) -> Float32Array:
        """(H, W, 3)."""
        return self._on_chart[1]

    @property
    def specular(self) -> Float32Array:
        """(H, W, 3)."""
        return self._on_chart[2]

    def picture(
        self, camera: ArrayLike | None = None, *, shape: GridShape = (512, 512), samples: int = 2
    ) -> Picture:
        """Return what a camera sees, a portrait from the front when omitted.

        Every sample is shaded for its own line of sight. ValueError for an invalid camera, a shape below 2
        pixels, or no sample.

        Parameters
        ----------
        camera : (3, 4) array_like of float, optional
            As in `geometry.pinhole`.
        shape : (H, W)
        samples : int
            On each side of a pixel.
        """
        view = face_view(self.face, camera, shape=shape, samples=samples)
        return view.picture(view.radiance(self.light))

    def write_glb(self, path: str | Path, *, exposure: float | None = None) -> None:
        """Write the face, with eyes and mouth, as a GLB that shines by itself, so no viewer lights it again.

        OutputError when it cannot be written, ValueError for an `exposure` that is not finite and above 0.
        """
        mask, mesh, inside, parts = self.face.mask, self.face.mesh, self.face.inside, list[GlbPart]()
        factor = auto_exposure(self.texture_linear[mask]) if exposure is None else checked_exposure(exposure)
        texture = encode_srgb_bytes(np.clip(factor * filled_from_nearest(self.texture_linear, mask), 0, 1))
        if inside is not None and inside.parts:
            texture = np.dstack([texture, np.where(inside.cut_mm > 0, np.uint8(0), np.uint8(255))])
            view = normalized(np.asarray(self.face.view_direction, float))
            for part in inside.parts:
                xyz, normals = part.vertices, vertex_normals(part.vertices, part.faces)
                toward = np.tile(view, (len(xyz), 1))
                surface = _wet_surface(self.face, xyz, normals, toward, np.asarray(part.color_linear))
                parts.append(replace(part, color_linear=factor * surface.radiance(self.light)))
        write_glb(path, mesh.vertices, mesh.faces, mesh.uv, texture, emissive=True, parts=parts)


def _checked(face: ProcessedFace, values: FloatArray) -> Float32Array:
    """Return light in single precision; ApplicationError where it is too bright for that."""
    if np.abs(values).max(initial=0.0) > np.finfo(np.float32).max:
        raise ApplicationError(f"{face.name} is lit brighter than 3e38: lower the intensities")
    return values.astype(np.float32)


@dataclass(frozen=True)
class FaceView:
    """What a camera sees of a face, whatever light falls on it."""

    face: ProcessedFace
    samples: SeenSamples
    surfaces: tuple[LitSurface, ...]
    """Skin, and what is seen behind its openings, whose points are the N of the samples, in this order."""

    def radiance(self, light: SceneLight) -> FloatArray:
        """Return (N, 3) the light that each sample sees; that of several lights is their sum."""
        return np.concatenate([surface.radiance(light) for surface in self.surfaces])

    def picture(self, radiance: FloatArray) -> Picture:
        """Return the picture of what the samples see (N, 3); ApplicationError where it is too bright."""
        covered = np.column_stack([radiance, np.ones(len(radiance))])
        made = _checked(self.face, self.samples.picture(covered))
        return Picture(made[..., :3], made[..., 3])


def face_view(
    face: ProcessedFace, camera: ArrayLike | None = None, *, shape: GridShape = (512, 512), samples: int = 2
) -> FaceView:
    """Return what a camera sees of a face as `relight` gives it; see `RelitFace.picture`."""
    if min(shape) < 2 or samples < 1:
        raise ValueError(f"shape is {shape}, samples {samples}, expected 2 pixels and 1 sample or more")
    mesh = face.mesh
    matrix = default_camera(face, shape) if camera is None else np.asarray(camera, float)
    projection = normalized_cameras(matrix[None])
    eye = camera_centers(projection)[0]
    seen = seen_samples(mesh.vertices, mesh.faces, projection[0], shape, samples)
    away = seen.interpolated(mesh.vertices) - eye
    outside = dots(seen.interpolated(mesh.normals), away) < 0
    seen, away = seen.chosen(outside), away[outside]
    if face.inside is None or not face.inside.parts or eye[2] <= mesh.vertices[:, 2].min():
        return FaceView(face, seen, (_skin_surface(face, seen, away),))
    # Eyes and mouth, where they are nearer, or the face is cut away before them.
    parts = face.inside.parts
    vertices, faces = join([(part.vertices, part.faces) for part in parts])
    behind = seen_samples(vertices, faces, projection[0], shape, samples)
    off = np.full((2, math.prod(shape) * samples**2), np.inf)
    off[0, seen.index] = lengths(away)
    off[1, behind.index] = lengths(behind.interpolated(vertices) - eye)
    before = np.flatnonzero(np.isfinite(off[1, seen.index]))
    at = pixels_from_uv(seen.chosen(before).interpolated(mesh.uv), face.mask.shape)
    cut = bilinear(face.inside.cut_mm[..., None], at)[:, 0] > 0
    off[0, seen.index[before[cut]]] = np.inf
    nearer = off[0] < off[1] + _DENT_MM  # lids of a scan may be dented into an eyeball
    kept, behind = nearer[seen.index], behind.chosen(~nearer[behind.index])
    seen, there = seen.chosen(kept), behind.interpolated(vertices)
    colors = behind.interpolated(np.concatenate([np.asarray(part.color_linear) for part in parts]))
    normal = behind.interpolated(np.concatenate([vertex_normals(p.vertices, p.faces) for p in parts]))
    wet = _wet_surface(face, there, normal, normalized(eye - there), colors)
    return FaceView(face, seen.joined(behind), (_skin_surface(face, seen, away[kept]), wet))


def _skin_surface(face: ProcessedFace, seen: SeenSamples, away: FloatArray) -> LitSurface:
    """Return the skin at the samples that see it, `away` (N, 3) from the camera."""
    mesh, mask, gloss = face.mesh, face.mask, face.image.specular_scale
    # The triangles of a chart lie below the curved surface, and its finer occluder would shade them:
    # Phong tessellation's 3/4 of the way to the tangent planes (Boubekeur and Alexa 2008).
    position = seen.raised(mesh.vertices, mesh.normals, 0.75 if mesh.from_chart else 0.0)
    caster = RayCaster(*face.image.occluder_mesh()) if face.casts_shadows else None
    normal = normalized(seen.interpolated(mesh.normals))
    shadows = ShadowMap(caster, position, normal, face.shadow_offset_mm, place=seen.place)
    pixels = pixels_from_uv(seen.interpolated(mesh.uv), mask.shape)
    albedo, scale = bilinear(filled_from_nearest(face.albedo_linear, mask), pixels), None
    if gloss is not None:
        scale = bilinear(filled_from_nearest(gloss[..., None], mask), pixels)[:, 0]
    return LitSurface(shadows, face.reflectance, normalized(-away), albedo, scale)


def _wet_surface(
    face: ProcessedFace, position: FloatArray, normal: FloatArray, toward: FloatArray, albedo: FloatArray
) -> LitSurface:
    """Return points (N, 3) of eyes and mouth, mm, all of it wet; the viewer is `toward` (N, 3)."""
    assert face.inside is not None
    cut_mm, own = face.inside.cut_mm, face.mesh
    vertices, faces = face.image.occluder_mesh()
    # Where the fitted surface itself casts the shadows, what is cut away, and half a millimetre of its
    # ragged edge, casts none on what is behind it.
    if len(vertices) == len(own.uv):
        gone = bilinear(cut_mm[..., None], pixels_from_uv(own.uv, cut_mm.shape))[:, 0] > -0.5
        faces = faces[~gone[faces].any(1)]
    caster = RayCaster(vertices, faces) if face.casts_shadows else None
    # Both sides of the bag of a mouth are seen.
    inward = dots(normal, toward) < 0
    outward = normalized(np.where(inward[:, None], -normal, normal))
    shadows = ShadowMap(caster, position, outward, face.shadow_offset_mm)
    # The highlight's peak beside a white surface, as of skin above; skin's albedo is a half.
    strength = WET_REFLECTANCE * WET_EXPONENT / 2 * face.level() / 0.5
    return LitSurface(shadows, Reflectance("lambert", 0.0, strength, WET_EXPONENT), toward, albedo)


def relight(
    face: ProcessedFace,
    lights: Sequence[PointLight] = (),
    *,
    environment_linear: ArrayLike | DistantLights | None = None,
    environment: EnvironmentLight | None = None,
    ambient: float | None = None,
    options: RelightOptions = RelightOptions(),
) -> RelitFace:
    """Return a face under point lights, distant lights or an environment map, with cast shadows.

        T = A (I_a + sum_k V_k E_k f(n, l_k, v)) + k_s sum_k V_k E_k phong(n, l_k, v)

    with the reflectance that the estimate found, or skin's usual highlight beside it, see `RelightOptions`.
    ``relight(face, face.lights, environment=face.environment, options=RelightOptions(gloss="found"))`` is the
    light of the scan. Raises `ApplicationError` for light that is negative, not finite or too bright, and for
    a lamp nearer to the origin than part of the face; `ValueError` or `TypeError` for other shapes or
    objects, and integers, which are not linear light.

    Parameters
    ----------
    face : ProcessedFace
        From `load_result`.
    lights : sequence of PointLight
    environment_linear : (H, W, 3) array_like of float, or DistantLights, optional
        Radiance; rows from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x. It shines as
        128 distant lights that lie where the map is bright.
    environment : EnvironmentLight, optional
        Soft light in spherical harmonics, without highlights. Its `bounce` holds for all light.
    ambient : float, optional
        Light without direction. When omitted 1, or 0 with an environment of either kind.
    options : RelightOptions
    """
    require_type(face, ProcessedFace, "relight: face", "load_result(folder) returns one")
    require_type(lights, Sequence, "relight: lights", "put PointLight objects into a list")
    for lamp in lights:
        advice = "make one with PointLight(azimuth_rad, elevation_rad)"
        require_type(lamp, PointLight, "relight: one of lights", advice)
    require_type(options, RelightOptions, "relight: options", "make them with RelightOptions()")
    advice = "give a picture as environment_linear, soft light as an EnvironmentLight"
    require_type(environment, (EnvironmentLight, type(None)), "relight: environment", advice)
    alone = environment_linear is None and environment is None
    base = float(alone) if ambient is None else ambient
    reach = float(norms(face.mesh.vertices).max())
    for k, lamp in enumerate(lights):
        if lamp.distance_mm <= reach:
            raise ApplicationError(
                f"light {k + 1} of {len(lights)} is {lamp.distance_mm:g} mm from the origin, but "
                f"{face.name} reaches {reach:.0f} mm; place it outside"
            )
    if not 0 <= base < np.inf:
        raise ApplicationError(f"ambient is {base}; it must be finite and not negative")
    distant = environment_linear
    if distant is not None and not isinstance(distant, DistantLights):
        require_linear("relight: environment_linear", distant)
        if np.min(distant, initial=0.0) < 0:
            raise ApplicationError(f"environment_linear holds {np.min(distant):.3g}; radiance is 0 or more")
        distant = DistantLights.from_environment(distant, 128, "important")
    light = SceneLight(lights, distant, base, environment)
    known, (face, notes) = face.inside, prepared_for_light(face, options)
    inside = eyes_and_mouth(face) if known is None else known
    object.__setattr__(face, "inside", inside)
    if inside.eyes and not inside.eyes[0].painted:
        notes = (*notes, f"{inside.reason}; see docs/applications.md")
    return RelitFace(face, light, notes)


def prepared_for_light(face: ProcessedFace, options: RelightOptions) -> tuple[ProcessedFace, Texts]:
    """Return the face as `relight` lights it, and what was assumed for it, for people."""
    notes = []
    if options.fill_gaps:
        filled = without_gaps(face)
        if filled is not face:
            part = np.mean((filled.albedo_linear != face.albedo_linear).any(-1)[face.mask])
            notes.append(f"{100 * part:.1f} % of the face was filled in: not seen, or hair at its sides")
        face = filled
    skin = face.reflectance
    if options.gloss == "none":
        skin = replace(skin, specular_strength=0.0)
    elif options.gloss == "auto" and skin.specular_strength == 0 and face.model_name != NO_MODEL:
        skin = replace(skin, specular_strength=SKIN_GLOSS * face.level(), exponent=SKIN_EXPONENT)
        scale, bare = face.image.specular_scale, face.image.skin
        if bare is not None:
            # The annotation's scale of highlights, lower where the texture shows hair and not skin.
            features = feature_texels(face)
            glossy = [~face.image.seen, *(features[name] for name in ("eyes", "mouth") if name in features)]
            bare = np.where(np.logical_or.reduce(glossy), 1.0, bare).astype(float)
            smooth = gaussian_filter(bare, AROUND / 2 * max(bare.shape), mode="mirror")
            scale = np.asarray(smooth if scale is None else smooth * scale, np.float32)
        face = replace(face, image=replace(face.image, specular_scale=scale))
        notes.append("no highlight was found, so skin's usual one is assumed")
    return replace(face, reflectance=skin), tuple(notes)


def default_camera(
    face: ProcessedFace,
    shape: GridShape = (512, 512),
    *,
    azimuth_rad: float = 0.0,
    elevation_rad: float = 0.0,
) -> FloatArray:
    """Return the (3, 4) camera of a portrait that holds all of the face.

    ValueError for an azimuth that is not finite, an elevation beyond 89 degrees, or a shape below 2 pixels.

    Parameters
    ----------
    face, shape : ProcessedFace, (H, W)
    azimuth_rad, elevation_rad : float
        Of the camera seen from the face: from +z toward +x, and toward +y.
    """
    if not abs(elevation_rad) < np.deg2rad(89):
        raise ValueError(f"elevation_rad is {elevation_rad}, expected between -89 and 89 degrees")
    if not np.isfinite(azimuth_rad) or min(shape) < 2:
        raise ValueError(f"azimuth_rad is {azimuth_rad}, shape {shape}, expected finite and 2 pixels or more")
    middle, radius, depth = pictures.portrait_frame(face.mesh.vertices)
    distance = max(pictures.DISTANCE_MM, 4 * radius)
    focal = (min(shape) - 1) / (2 * pictures.PORTRAIT_MARGIN * radius) * (distance - depth / 2)
    toward = PointLight(azimuth_rad, elevation_rad).direction
    return look_at(middle + distance * toward, middle, focal_px=focal, shape=shape)
