"""`relight`: a processed face under other light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.applications.face_features import feature_texels
from scan2albedo.applications.face_gaps import without_gaps
from scan2albedo.applications.pictures import Picture, auto_exposure, checked_exposure, photograph
from scan2albedo.applications.processed_face import NO_MODEL, ProcessedFace, on_grid
from scan2albedo.applications.scene_light import SceneLight, shade
from scan2albedo.core.arguments import require_linear, require_type
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.environment_light import EnvironmentLight
from scan2albedo.core.point_light import PointLight
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.glb import write_glb
from scan2albedo.lighting.environment import DistantLights, LightSpread
from scan2albedo.lighting.shadow_map import ShadowMap

Gloss = Literal["auto", "found", "none"]

SKIN_GLOSS, SKIN_EXPONENT = 0.25, 12.0
"""Usual highlight of skin as a part of its albedo's level, and Phong's exponent. A dielectric of index 1.4
reflects F = 0.028; Beckmann's lobe of slope m = 0.2, which Phong's exponent 1 / (2 m^2) = 12 follows, peaks
at pi F / (4 pi m^2) = 0.17 of a white surface, and skin's albedo is 0.5 to 0.7."""

_SKIN_BLUR = 0.01
"""Of the image's side: over what the likelihood of bare skin is averaged."""


@dataclass(frozen=True)
class RelightOptions:
    """Settings of `relight`."""

    shadows: bool | None = None
    """Cast shadows; None casts them when the estimate found that the surface shades itself."""
    environment_lights: int = 128
    """Distant lights that stand for an environment map."""
    environment_spread: LightSpread = "important"
    """Whether these lights lie where the map is bright, which gives a fifth of the error, or evenly, so that
    the light of two maps adds up."""
    gloss: Gloss = "auto"
    """"found" is the highlight of the estimate, "none" leaves it off; "auto" gives a face fitted with a model
    skin's usual highlight where the estimate found none."""
    fill_gaps: bool = True
    """Put smooth skin where none was seen and on dark sides before the ears, which are black patches else."""

    def __post_init__(self) -> None:
        for name, known in (("gloss", Gloss), ("environment_spread", LightSpread)):
            if (value := getattr(self, name)) not in get_args(known):
                raise ValueError(f"{name} is {value!r}, expected one of {get_args(known)}")


@dataclass(frozen=True)
class RelitFace:
    """A face under light."""

    face: ProcessedFace
    light: SceneLight
    """`face`, `light`: what is lit, with its gloss and without gaps, and by what."""
    texture_linear: NDArray[np.float32]
    """(H, W, 3): albedo times `diffuse`, plus `specular`; 0 outside the mask, not clipped."""
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    """`diffuse`, `specular`: (H, W, 3)."""
    shadows: bool
    """Whether shadows were cast."""
    notes: tuple[str, ...] = ()
    """What was assumed or filled, for people."""

    def picture(
        self, camera: ArrayLike | None = None, *, shape: tuple[int, int] = (512, 512), samples: int = 2
    ) -> Picture:
        """Return what a camera (3, 4) sees, a portrait from the front when omitted; see `photograph`.

        Parameters
        ----------
        camera : (3, 4) array_like of float, optional
        shape : (H, W)
        samples : int
            On each side of a pixel.
        """
        return photograph(
            self.face, self.light, camera=camera, shape=shape, samples=samples, shadows=self.shadows
        )

    def write_glb(self, path: str | Path, *, exposure: float | None = None) -> None:
        """Write the face with its relit texture as a GLB that shines by itself, so no viewer lights it again.

        OutputError when the folder cannot be written, ValueError for an exposure that is not finite and above
        0.
        """
        mask = self.face.mask
        factor = auto_exposure(self.texture_linear[mask]) if exposure is None else checked_exposure(exposure)
        texture = encode_srgb_bytes(np.clip(factor * filled_from_nearest(self.texture_linear, mask), 0, 1))
        mesh = self.face.mesh
        write_glb(path, mesh.vertices, mesh.faces, mesh.uv, texture, emissive=True)


def relight(
    face: ProcessedFace,
    lights: Sequence[PointLight] = (),
    *,
    environment_linear: ArrayLike | None = None,
    environment: EnvironmentLight | None = None,
    ambient: float | None = None,
    options: RelightOptions = RelightOptions(),
) -> RelitFace:
    """Return a face under point lights, distant lights or an environment map, with cast shadows.

        T = A (I_a + sum_k V_k E_k f(n, l_k, v)) + k_s sum_k V_k E_k phong(n, l_k, v)

    with the reflectance that the estimate found, or skin's usual highlight beside it, see `RelightOptions`:
    linear in the light, highlights in the colour of their lamp.
    ``relight(face, face.lights, environment=face.environment, options=RelightOptions(gloss="found"))`` is the
    light of the scan.

    Parameters
    ----------
    face : ProcessedFace
        From `load_result`.
    lights : sequence of PointLight
    environment_linear : (H, W, 3) array_like of float, optional
        Radiance; rows from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x. It shines as
        a weighted sum of distant lights, each the integral over its cell of the sphere. The result is linear
        in it where these lights are spread evenly, see `RelightOptions`.
    environment : EnvironmentLight, optional
        Soft light in spherical harmonics, without highlights. Its `bounce` holds for all light.
    ambient : float, optional
        Light without direction. When omitted 1, as `AlbedoEstimate.relit` has it, or 0 with an environment of
        either kind, which is all the light there is.
    options : RelightOptions

    Raises
    ------
    ApplicationError
        For ambient light that is negative or not finite, an environment that is negative, a lamp nearer to
        the origin than part of the face, or light beyond what single precision holds.
    ValueError
        For an environment of another shape.
    TypeError
        For other objects than a face and lights, or an environment in integers, which is no linear light.

    Examples
    --------
    >>> from scan2albedo.synthetic import hemisphere, light_at
    >>> scene = hemisphere(size=32)
    >>> face = ProcessedFace.of("ball", scene.image, scene.albedo_linear)
    >>> relit = relight(face, [light_at(30, intensity=2.0)])
    >>> relit.texture_linear.shape
    (32, 32, 3)
    """
    require_type(face, ProcessedFace, "relight: face", "load_result(folder) returns one")
    require_type(lights, Sequence, "relight: lights", "put PointLight objects into a list")
    for lamp in lights:
        advice = "make one with PointLight(azimuth_rad, elevation_rad)"
        require_type(lamp, PointLight, "relight: one of lights", advice)
    require_type(options, RelightOptions, "relight: options", "make them with RelightOptions()")
    require_type(
        environment,
        (EnvironmentLight, type(None)),
        "relight: environment",
        "give a picture as environment_linear, soft light as an EnvironmentLight",
    )
    if environment_linear is not None:
        require_linear("relight: environment_linear", environment_linear)
    alone = environment_linear is None and environment is None
    base = float(alone) if ambient is None else ambient
    _check_lights(face, lights, base)
    if environment_linear is not None and np.min(environment_linear, initial=0.0) < 0:
        raise ApplicationError(
            f"environment_linear goes down to {np.min(environment_linear):.3g}; radiance is 0 or more"
        )
    distant = None
    if environment_linear is not None:
        distant = DistantLights.from_environment(
            environment_linear, options.environment_lights, options.environment_spread
        )
    light = SceneLight.of(lights, distant, ambient=base, soft=environment)
    shadows = face.casts_shadows if options.shadows is None else options.shadows
    face, notes = as_lit(face, options)
    view = np.asarray(face.view_direction, np.float64)
    image, mask = face.image, face.mask
    shadow_map = ShadowMap(
        RayCaster(*image.occluder_mesh()) if shadows and light.casts else None,
        image.position[mask],
        image.normal[mask],
        face.shadow_offset_mm,
    )
    scale = None if image.specular_scale is None else image.specular_scale[mask].astype(np.float64)
    lit = shade(shadow_map, light, face.reflectance, view / np.linalg.norm(view), scale)
    texture = face.albedo_linear[mask].astype(np.float64) * lit.diffuse + lit.specular
    pictures = [_chart_image(face, values) for values in (texture, lit.diffuse, lit.specular)]
    return RelitFace(face, light, pictures[0], pictures[1], pictures[2], shadows, notes)


def as_lit(face: ProcessedFace, options: RelightOptions) -> tuple[ProcessedFace, tuple[str, ...]]:
    """Return the face as `relight` lights it, and what was assumed for it, for people."""
    notes = []
    if options.fill_gaps:
        filled = without_gaps(face)
        if filled is not face:
            part = np.mean((filled.albedo_linear != face.albedo_linear).any(-1)[face.mask])
            notes.append(
                f"{100 * part:.1f} % of the face was filled from beside it: not seen, or dark at its sides"
            )
        face = filled
    skin = face.reflectance
    if options.gloss == "none":
        skin = replace(skin, specular_strength=0.0)
    elif options.gloss == "auto" and skin.specular_strength == 0 and face.model_name != NO_MODEL:
        skin = replace(skin, specular_strength=SKIN_GLOSS * face.level(), exponent=SKIN_EXPONENT)
        face = replace(face, image=replace(face.image, specular_scale=_skin_scale(face)))
        notes.append("no highlight was found, so skin's usual one is assumed")
    return replace(face, reflectance=skin), tuple(notes)


def _skin_scale(face: ProcessedFace) -> NDArray[np.float32] | None:
    """Return (H, W) the annotation's scale of highlights, lower where the texture shows hair, no skin."""
    scale, skin = face.image.specular_scale, face.image.skin
    if skin is None:
        return scale
    import cv2

    features = feature_texels(face)
    glossy = [~face.image.seen, *(features[name] for name in ("eyes", "mouth") if name in features)]
    bare = np.where(np.logical_or.reduce(glossy), 1.0, skin).astype(np.float64)
    smooth = cv2.GaussianBlur(bare, (0, 0), _SKIN_BLUR * max(skin.shape))
    return np.asarray(smooth if scale is None else smooth * scale, np.float32)


def _chart_image(face: ProcessedFace, values: FloatArray) -> NDArray[np.float32]:
    if np.abs(values).max() > np.finfo(np.float32).max:
        raise ApplicationError(
            f"{face.name} is lit brighter than 3e38, which no picture holds; lower the intensities"
        )
    return on_grid(face.mask, values).astype(np.float32)


def _check_lights(face: ProcessedFace, lights: Sequence[PointLight], ambient: float) -> None:
    reach = float(np.linalg.norm(face.mesh.vertices, axis=1).max())
    for k, light in enumerate(lights):
        if light.distance_mm <= reach:
            raise ApplicationError(
                f"light {k + 1} of {len(lights)} is {light.distance_mm:g} mm from the origin, but "
                f"{face.name} reaches {reach:.0f} mm; place it outside"
            )
    if not 0 <= ambient < np.inf:
        raise ApplicationError(f"ambient is {ambient}; it must be finite and not negative")
