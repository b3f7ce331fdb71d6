"""The light that a search found, on every texel: lamps with their shadows, soft light, and colours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from scan2albedo.albedo.levels import along_surface, cell_field, cell_means
from scan2albedo.albedo.light_colour import LightColours
from scan2albedo.albedo.light_parameters import Solution
from scan2albedo.albedo.lit_image import LightFound, LitImage
from scan2albedo.albedo.node_field import TINY, deviation_of_light
from scan2albedo.albedo.posterior import EXTRA, FREEDOM, Point
from scan2albedo.albedo.prior import SPREADS
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.environment_light import EnvironmentLight
from scan2albedo.core.point_light import PointLight
from scan2albedo.lighting.environment_light import open_shading, open_transfer
from scan2albedo.lighting.harmonics import harmonics as harmonics_of
from scan2albedo.lighting.shading import Reflectance, Shading, shade_rows
from scan2albedo.lighting.shadow_map import ShadowMap

HALF_STEP = 2 / 255
"""Rounding of 8 bits, as a part of the median V where that is a quarter."""
_LEAST = 0.001
"""A traced shadow is wrong this often anywhere: what casts it may not be part of the surface."""


@dataclass(frozen=True)
class TexelLight:
    """The light on the N masked texels, and what it comes from."""

    light_linear: FloatArray
    """(N, 3)."""
    specular: FloatArray
    """(N, 3) in the unit of the texture."""
    visible: FloatArray
    """(N,) 0 where some lamp is hidden."""
    deviation: FloatArray
    """(N,) standard deviation of the log of the light over the explanations."""
    lights: tuple[PointLight, ...]
    """Strongest first, in their colours."""
    environment: EnvironmentLight | None
    """None for the constant white ambient light of 1."""
    reflectance: Reflectance
    """With the highlight in the unit of the texture."""


def light_on_texels(scene: LitImage, found: LightFound) -> TexelLight:
    """Return the light found on the image at its full size, with the mean of what explains it as well."""
    told = found.explanation
    if told is None:
        return _of_solution(scene, found.solution, None, LightColours.white(found.solution.model.lights))
    lit = _of_solution(scene, found.solution, told.best, told.colours)
    cells = np.column_stack([told.shift, told.spread])
    *shift, spread = cell_field(told.level, cells, scene.image.mask).T
    light = lit.light_linear * np.exp(np.stack(shift, 1))
    return replace(lit, light_linear=light, deviation=spread)


def _of_solution(
    scene: LitImage, solution: Solution, point: Point | None, colours: LightColours
) -> TexelLight:
    """Return the light of one explanation; without `point` it is that of the paper's search."""
    image, mask, state, caster = scene.image, scene.image.mask, solution.hypothesis, scene.shadows[0]
    unit = scene.at(scene.options.sizes[0]).level.unit
    strength = state.reflectance.specular_strength * unit * colours.gloss
    reflectance = replace(state.reflectance, specular_strength=strength)
    order, lights = np.argsort(-state.rows[:, 4], kind="stable"), list(state.lights())
    surface = image.position[mask], image.normal[mask].astype(np.float64)
    above = None
    if point is not None and caster is not None:
        above = scene.at(scene.options.sizes[2]).horizon.at(np.argwhere(mask))
    hidden, attached = ShadowMap(caster, *surface, open_above=above), ShadowMap(None, *surface)
    visible, facing = np.ones((2, len(lights), len(surface[0])), np.float32)
    for k, lamp in enumerate(lights):
        at = lamp.direction, lamp.distance_mm, lamp.radius_deg
        visible[k], facing[k] = hidden.reached(*at), attached.reached(*at)
    scale = np.ones(mask.shape) if image.specular_scale is None else image.specular_scale
    scale = scale[mask].astype(np.float64)
    colors = replace(colours, lamps=colours.lamps[order])

    def shading(seen: NDArray) -> Shading:
        return shade_rows(*surface, seen, state.rows[order], scene.toward, reflectance, scale, colors.lamps)

    whole = shading(np.ones_like(visible)).lamps
    known, environment, soft = None if point is None else _Expected(scene, point), None, np.zeros((1, 3))
    softly = known is not None or any(map(solution.model.has, ("occlusion", "bounce", "environment")))
    if softly:
        environment, soft = _soft_light(scene, solution, visible * whole, colors)
    if known is not None and lights and caster is not None:
        visible = _seen_shadows(scene, known, visible, facing, whole, soft.mean(-1))
    shaded = shading(visible)
    light = np.maximum(shaded.lamps.T @ colors.lamps + soft, DARKEST) if softly else shaded.light_linear
    if known is not None:
        for k, color in enumerate(colors.lamps):
            # A colour's mean goes into the lamp's intensity.
            mean = float(color.mean())
            red, green, blue = (color / mean).tolist()
            intensity = lights[k].intensity * mean
            lights[k] = replace(lights[k], intensity=intensity, color_linear=(red, green, blue))
        lead = known.point.problem.lead
        stray = _unmodelled(scene, known, light[:, lead], shaded.specular / unit)
        light *= np.exp(known.nodes @ colors.cast + stray[:, None])
    return TexelLight(
        light,
        shaded.specular_linear,
        visible.min(0, initial=1).astype(np.float64),
        np.zeros(len(light)),
        tuple(lights),
        environment,
        reflectance,
    )


class _Expected:
    """What a point knows of log albedo on N texels: the faces' `mean` (N,), the `deviation` (N,) of single
    texels, and the weights `nodes` (N, M) of the field's nodes."""

    def __init__(self, scene: LitImage, point: Point) -> None:
        self.point = point
        field, places, first = point.problem.field, scene.places, slice(1)
        self.mean = field.prior.mean_at(places, first)[:, 0]
        self.deviation = field.prior.deviation_at(places, first)[:, 0]
        weights = field.weights(places)
        # Texels beyond the nodes in use have those that are near.
        whole = np.maximum(np.asarray(weights.sum(1)).ravel(), TINY)
        self.nodes = (sparse.diags(1 / whole) @ weights).tocsr()


def _seen_shadows(
    scene: LitImage, known: _Expected, visible: NDArray, facing: NDArray, lamps: FloatArray, soft: FloatArray
) -> NDArray[np.float32]:
    """Return (L, N) how probably each lamp reaches each texel.

    The prior odds are those of the traced shadow, blurred by what the surface may err by; the picture adds
    those of the texel's brightness, under the albedo that is expected there, with the lamp and without.
    `lamps` (L, N) is the light of each lamp where nothing hides it, `soft` (N,) all other light.
    """
    point, mask, side = known.point, scene.image.mask, max(scene.image.shape)
    scale, likeness = point.x[-EXTRA:]
    expected = scale + likeness * known.mean + known.nodes @ point.u
    value = np.log(np.maximum(scene.value[mask] / point.problem.level.unit, 1e-3)) - expected

    def blurred(values: FloatArray, sigma: float) -> FloatArray:
        field = np.zeros(mask.shape)
        field[mask] = values
        return np.asarray(gaussian_filter(field, sigma * side)[mask])

    blur = point.problem.blur
    whole = blurred(np.ones(len(value)), blur)
    seen, judged = visible.astype(np.float64), scene.usable[mask].astype(np.float64)
    away = facing == 0
    priors = [
        np.clip(blurred(np.where(hid, 1.0, v), blur) / whole, _LEAST, 1 - _LEAST)
        for v, hid in zip(visible, away, strict=True)
    ]
    for _ in range(2):
        for k, prior in enumerate(priors):
            others = np.maximum(soft + (seen * lamps).sum(0) - seen[k] * lamps[k], DARKEST)
            without, lit = np.log(others), np.log(others + lamps[k])
            step = lit - without
            odds = (value - 0.5 * (without + lit)) * step / (SPREADS[0] ** 2 + DARKEST / others) * judged
            odds = np.clip(odds, -6.0, 6.0)
            odds += np.log(prior / (1 - prior))
            seen[k] = np.where(away[k], 1.0, 1 / (1 + np.exp(-odds)))
    return np.where(away, 0.0, seen).astype(np.float32)


def _unmodelled(scene: LitImage, known: _Expected, light: FloatArray, specular: FloatArray) -> FloatArray:
    """Return (N,) the log of light that no part stands for, as the posterior has it at each texel.

    Log V is the sum of log light, of what is known of log albedo here, of grain, and of this: it takes the
    part of what is left that its variance, large where light ends, has of the variance of both.
    """
    point, p, mask = known.point, known.point.problem, scene.image.mask
    level, nodes = point.albedo_nodes()
    value = np.maximum(scene.value[mask] / p.level.unit - specular, HALF_STEP)
    left = np.log(value / light) - level - point.x[-1] * known.mean - known.nodes @ nodes
    usable = scene.usable[mask]
    # The texture of this surface is rougher than that of a prior's cells: most texels show how much.
    measured = float(norm.ppf(0.75) ** -1 * np.median(np.abs(left[usable])))
    grain = np.maximum(known.deviation, measured) ** 2
    # A brow, a mole, hair: Student's t, whose variance grows with what is seen. Little is that bright.
    grain = (FREEDOM * grain + np.minimum(left, 0.0) ** 2) / FREEDOM
    stray = point.known.scales.light * deviation_of_light(light, float(np.median(light[usable])))
    unknown = stray**2 + (HALF_STEP / value) ** 2
    return np.asarray(left * unknown / (grain + unknown))


def _soft_light(
    scene: LitImage, solution: Solution, lamps: FloatArray, colours: LightColours
) -> tuple[EnvironmentLight, FloatArray]:
    """Return the environment, and its light (N, 3) with what the surface throws onto itself.

    `lamps` (L, N) is the light of the lamps, of which it throws too; the colours are in their order.
    """
    model, mask, caster = solution.model, scene.image.mask, scene.shadows[0]
    state = model.soft(solution.x)
    harmonics = np.vstack([colours.ambient, state.harmonics[:, None] + colours.harmonics])
    environment = EnvironmentLight(
        harmonics, occluded=caster is not None, fill=state.fill, bounce=state.bounce
    )
    light = harmonics_of(scene.image.normal[mask], 2) @ open_shading(environment)
    if caster is None:
        return environment, light
    # What the surface hides and what it throws back changes slowly along it, and comes from cells.
    finest = scene.at(scene.options.sizes[2])
    level, terms = finest.level, finest.soft
    hidden = open_transfer(level.normal) - terms.transfer
    hidden[:, 0] *= 1 - state.fill
    change = -hidden @ harmonics
    if terms.bounce is not None and state.bounce:
        direct = cell_means(level, lamps.sum(0), mask) + terms.transfer[:, 1:] @ state.harmonics
        change += state.bounce * terms.bounce(direct)[:, None] * colours.bounce
    return environment, light + along_surface(level, change, scene.image)
