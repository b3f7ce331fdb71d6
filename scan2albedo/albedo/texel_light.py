"""The light that a search found, on every texel: lamps with exact shadows, soft light, and colours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scan2albedo.albedo.levels import along_surface, cell_means
from scan2albedo.albedo.light_parameters import HARMONICS
from scan2albedo.albedo.lit_image import LightFound, LitImage
from scan2albedo.albedo.options import SHADOW_OFFSET_MM
from scan2albedo.albedo.result import LitSurface, shade_image
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.environment_light import EnvironmentLight
from scan2albedo.core.point_light import PointLight
from scan2albedo.lighting.environment_light import open_transfer
from scan2albedo.lighting.shading import Reflectance


@dataclass(frozen=True)
class TexelLight:
    """The light on the N masked texels, and what it comes from."""

    light: FloatArray
    """(N,) mean over the channels."""
    light_linear: FloatArray
    """(N, 3)."""
    specular: FloatArray
    """(N,) in the unit of the texture."""
    visible: FloatArray
    """(N,) 0 where some lamp is hidden."""
    cast: FloatArray
    """(N,) 1 where some lamp's cast shadow lies."""
    lights: tuple[PointLight, ...]
    """Strongest first, in their colours."""
    environment: EnvironmentLight | None
    """None for the constant white ambient light of 1."""
    reflectance: Reflectance
    """With the highlight in the unit of the texture."""


def light_on_texels(scene: LitImage, found: LightFound) -> TexelLight:
    """Return the light found on the image at its full size."""
    state = found.solution.hypothesis
    strength = state.reflectance.specular_strength * found.unit
    reflectance, lamps = replace(state.reflectance, specular_strength=strength), state.lights()
    offset = SHADOW_OFFSET_MM
    toward = scene.image.toward_camera(scene.view)
    where = scene.image, lamps, reflectance, toward, found.caster, offset
    lit = shade_image(*where, open_above=scene.open_above())
    count = found.solution.model.lights
    colors = np.ones((count + HARMONICS + 2, 3)) if found.colors is None else found.colors.copy()
    # In the order of the public lights, strongest first.
    colors[:count] = colors[np.argsort(-found.solution.hypothesis.rows[:, 4], kind="stable")]
    environment, light = _with_soft_light(scene, found, lit, colors)
    # A colour's mean goes into the lamp's intensity.
    coloured = list(lamps)
    for k, color in enumerate(colors[: len(lamps)]):
        mean = float(color.mean())
        if (color != 1).any() and mean > 0:
            red, green, blue = (color / mean).tolist()
            intensity = lamps[k].intensity * mean
            coloured[k] = replace(lamps[k], intensity=intensity, color_linear=(red, green, blue))
    return TexelLight(
        light.mean(-1),
        light,
        lit.shading.specular,
        lit.visible.min(0, initial=1),
        lit.cast.max(0, initial=0),
        tuple(coloured),
        environment,
        reflectance,
    )


def _with_soft_light(
    scene: LitImage, found: LightFound, lit: LitSurface, colors: FloatArray
) -> tuple[EnvironmentLight | None, FloatArray]:
    """Return the environment and all light (N, 3) in its colours."""
    model = found.solution.model
    if (colors == 1).all() and not (model.occlusion or model.bounce or model.environment):
        return None, lit.shading.light_linear
    state, lamps, mask = model.soft(found.solution.x), lit.shading.lamps, scene.image.mask
    harmonics = np.append(1.0, state.harmonics)[:, None] * colors[model.lights : -1]
    environment = EnvironmentLight(
        harmonics, occluded=found.caster is not None, fill=state.fill, bounce=state.bounce
    )
    light = lamps.T @ colors[: model.lights] + open_transfer(scene.image.normal[mask]) @ harmonics
    if found.caster is None:
        return environment, np.maximum(light, DARKEST)
    # What the surface hides and what it throws back changes slowly along it, and comes from cells.
    level = scene.level(scene.options.sizes[2])
    terms = scene.soft(level)
    hidden = open_transfer(level.normal) - terms.transfer
    hidden[:, 0] *= 1 - state.fill
    change = -hidden @ harmonics
    if terms.bounce is not None and state.bounce:
        direct = cell_means(level, lamps.sum(0), mask) + terms.transfer[:, 1:] @ state.harmonics
        change += state.bounce * terms.bounce(direct)[:, None] * colors[-1]
    return environment, np.maximum(light + along_surface(level, change, scene.image), DARKEST)
