"""The light that a search found, on every texel: lamps with their shadows, soft light, and colours."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.ndimage import gaussian_filter

from scan2albedo.albedo.levels import along_surface, cell_field, cell_means
from scan2albedo.albedo.light_colour import CAST, LightColours
from scan2albedo.albedo.light_parameters import PARTS, Solution
from scan2albedo.albedo.node_field import TINY, deviation_of_light
from scan2albedo.albedo.posterior import FREEDOM, Point
from scan2albedo.albedo.prior import SPREADS
from scan2albedo.albedo.shaded_image import LightFound, ShadedImage
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.core import EnvironmentLight, PointLight
from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, dots, row_sums
from scan2albedo.lighting.environment_light import open_shading, open_transfer
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.shading import Reflectance, lamp_factors
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.statistics.robust import normal_deviation

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


def light_on_texels(scene: ShadedImage, found: LightFound) -> TexelLight:
    """Return the light found on the image at its full size, with the mean of what explains it as well."""
    mask, caster = scene.image.mask, scene.shadows[0]
    solution, explained = found.solution, found.explanation
    state = solution.hypothesis
    order, lights = np.argsort(-state.rows[:, 4], kind="stable"), list(state.lights())
    rows = state.rows[order]
    unit = scene.at(scene.options.sizes[0]).level.unit
    gain = 1.0 if explained is None else explained.colours.gloss
    strength = state.reflectance.specular_strength * unit * gain
    reflectance = replace(state.reflectance, specular_strength=strength)
    hidden = _surface(scene, softly=explained is not None)
    visible, whole, gloss = _lamps_on_texels(scene, rows, lights, reflectance, hidden)
    if explained is None:
        light, specular = (np.tile((visible * part).sum(0)[:, None], 3) for part in (whole, gloss))
        seen = visible.min(0, initial=1).astype(float)
        return TexelLight(1 + light, specular, seen, np.zeros(len(seen)), tuple(lights), None, reflectance)
    colours = replace(explained.colours, lamps=explained.colours.lamps[order])
    lights = list(map(_coloured, lights, colours.lamps))
    environment, soft = _soft_light(scene, solution, visible * whole, colours, hidden)
    known = _Expected(scene, explained.best, colours.step.ran)
    if lights and caster is not None:
        visible = _seen_shadows(known, mask, visible, whole[..., None] * colours.lamps[:, None], soft)
    light = np.maximum((visible * whole).T @ colours.lamps + soft, DARKEST)
    light *= np.exp(known.nodes @ colours.cast)
    specular = (visible * gloss).T @ colours.lamps
    share, stray = _left_over(known, light, (specular / unit).astype(np.float32))
    of_cells = np.column_stack([explained.shift, explained.spread])
    shift, spread = cell_field(explained.level, of_cells, mask).T
    light *= np.exp(stray + shift[:, None])
    seen = visible.min(0, initial=1).astype(float)
    return TexelLight(light, specular * share, seen, spread, tuple(lights), environment, reflectance)


def _coloured(lamp: PointLight, color: FloatArray) -> PointLight:
    """Return a lamp in a colour (3,), whose mean goes into its intensity."""
    mean = float(color.mean())
    red, green, blue = (color / mean).tolist()
    return replace(lamp, intensity=lamp.intensity * mean, color_linear=(red, green, blue))


def _surface(scene: ShadedImage, softly: bool) -> ShadowMap:
    """Return the texels, with the horizon above which nothing hides a lamp where soft light knows it."""
    image, mask, caster = scene.image, scene.image.mask, scene.shadows[0]
    above = None
    if softly and caster is not None:
        above = scene.at(scene.options.sizes[2]).horizon.at(np.argwhere(mask))
    return ShadowMap(caster, image.position[mask], image.normal[mask].astype(float), open_above=above)


def _lamps_on_texels(
    scene: ShadedImage,
    rows: FloatArray,
    lights: list[PointLight],
    reflectance: Reflectance,
    surface: ShadowMap,
) -> tuple[Float32Array, FloatArray, FloatArray]:
    """Return (L, N) the part of each lamp that reaches texels, its light and highlight where all does."""
    count = len(surface.position)
    traced = [surface.reached(lamp.direction, lamp.distance_mm, lamp.radius_deg) for lamp in lights]
    visible = np.reshape(traced, (len(lights), count)).astype(np.float32)
    unshadowed = np.ones_like(visible)
    factors = lamp_factors(surface.position, surface.normal, unshadowed, rows, scene.toward, reflectance)
    whole, gloss = factors * rows[:, 4:]
    gloss *= reflectance.specular_strength
    if scene.image.specular_scale is not None:
        gloss *= scene.image.specular_scale[scene.image.mask]
    return visible, whole, gloss


class _Expected:
    """What a point knows of log albedo on N texels: the `level` (N,) of the leading channel with the
    `deviation` of single texels, the `ratios` (N, 3) of the others to it, and the nodes' weights `nodes`."""

    parts = np.linspace(0, 1, 9)  # of a lamp, or of twice a highlight, that are compared

    def __init__(self, scene: ShadedImage, point: Point, coloured: bool) -> None:
        (field, places), mask = (point.problem.field, scene.places), scene.image.mask
        self.point, self.coloured, self.usable = point, coloured, scene.usable[mask]
        self.lead, self.first = point.problem.lead, np.arange(3) == point.problem.lead
        mean, self.deviation = field.prior.mean_at(places), field.prior.deviation_at(places, slice(1))
        weights = field.weights(places)
        # Texels beyond the nodes in use have those that are near.
        whole = np.maximum(row_sums(weights), TINY)
        self.nodes = (sparse.diags(1 / whole) @ weights).tocsr()
        level, nodes = point.albedo_nodes()
        self.level = (level + point.x[-1] * mean[:, 0] + self.nodes @ nodes).astype(np.float32)
        mean[:, 0] = 0.0
        self.ratios = (mean - mean[:, [self.lead]]).astype(np.float32)
        assert scene.image.texture_linear is not None
        texels = np.where(self.first, scene.value[mask][:, None], scene.image.texture_linear[mask])
        self.texels = (np.maximum(texels, 0.0) / point.problem.level.unit).astype(np.float32)

    def left(self, light: FloatArray, gloss: FloatArray | float = 0.0) -> FloatArray:
        """Return (N, 3) log texels less log light and log albedo: the leading channel, others beside it."""
        logs = np.log(np.maximum(self.texels - gloss, HALF_STEP) / np.maximum(light, DARKEST, dtype="f4"))
        ratios = logs - logs[:, [self.lead]] - self.ratios
        return np.where(self.first, logs - self.level[:, None], self.coloured * ratios)

    def settle(self, light: FloatArray, gloss: FloatArray | float = 0.0) -> None:
        """Let most texels tell the person's ratios, in this light."""
        self.ratios += np.median(self.left(light, gloss)[self.usable], 0) * ~self.first

    def mean_part(
        self, left: Iterable[FloatArray], dark: FloatArray | float, prior: FloatArray
    ) -> FloatArray:
        """Return (N,) the mean of parts 0 to 1, by what each leaves, `dark` of its variance, and a prior."""
        # One part after the other: all their channels at once are most of what a large chart needs.
        misfit = np.stack([dots(part, part) for part in left])
        fits = -0.5 * self.usable * misfit / (SPREADS[0] ** 2 + dark)
        chance = np.exp(np.maximum(fits - fits.max(0), -6.0)) * prior
        return self.parts @ chance / chance.sum(0)


def _seen_shadows(
    known: _Expected, mask: BoolArray, visible: Float32Array, lamps: FloatArray, soft: FloatArray
) -> Float32Array:
    """Return (L, N) the part of each lamp that reaches each texel, as far as is known.

    Its prior is the traced shadow, blurred by what the surface may err by: none, all or, beside an outline,
    any part. The picture adds how well brightness and colour go with the albedo that is expected there.
    `lamps` (L, N, 3) is the light of each lamp where nothing hides it, `soft` (N, 3) all other light.
    """
    away = lamps.max(2) == 0

    def blurred(values: FloatArray) -> FloatArray:
        field = np.zeros(mask.shape)
        field[mask] = values
        return gaussian_filter(field, known.point.problem.blur * max(mask.shape))[mask]

    whole, seen = blurred(np.ones(len(soft))), visible.astype(float)
    priors = [np.clip(blurred(v) / whole, _LEAST, 1 - _LEAST) for v in np.where(away, 1.0, visible)]
    known.settle(soft + np.einsum("ln,lnc->nc", seen, lamps))
    for _ in range(2):
        for k, reached in enumerate(priors):
            others = soft + np.einsum("ln,lnc->nc", seen, lamps) - seen[k][:, None] * lamps[k]
            prior = np.tile(reached * (1 - reached) / (len(known.parts) - 2), (len(known.parts), 1))
            prior[0], prior[-1] = (1 - reached) * (1 - reached / 2), reached * (1 + reached) / 2
            left = (known.left(others + part * lamps[k]) for part in known.parts)
            dark = DARKEST / np.maximum(others[:, known.lead], DARKEST)
            seen[k] = np.where(away[k], 1.0, known.mean_part(left, dark, prior))
    return np.where(away, 0.0, seen).astype(np.float32)


def _left_over(known: _Expected, light: FloatArray, gloss: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (N, 1) what the highlights `gloss` (N, 3) are times, and (N, 3) the log of stray light.

    Highlights err by half, and none exceeds its texel. Of what log light and what is known of log albedo
    leave, stray light takes the part that its variance, large where light ends, has of its and grain's.
    """
    known.settle(light, gloss)
    prior = [np.exp(-2 * (2 * p - 1) ** 2) * (known.texels >= 2 * p * gloss).all(1) for p in known.parts]
    rest = (known.left(light, 2 * part * gloss) for part in known.parts)
    share = 2 * known.mean_part(rest, 0.0, np.stack(prior))[:, None]
    left, first, usable = known.left(light, share * gloss), known.first, known.usable
    # The texture of this surface is rougher than that of a prior's cells: most texels show how much.
    measured = normal_deviation(left[usable], 0)
    grain = np.where(first, np.maximum(known.deviation, measured), np.hypot(measured, SPREADS[1])) ** 2
    # A brow, a mole, hair: Student's t, whose variance grows with what is seen. Little is that bright.
    grain = (FREEDOM * grain + np.where(first, np.minimum(left, 0.0), left) ** 2) / FREEDOM
    lead, value = light[:, [known.lead]], np.maximum(known.texels - share * gloss, HALF_STEP)
    stray = known.point.known.scales.light * deviation_of_light(lead, float(np.median(lead[usable])))
    unknown = np.where(first, 1.0, CAST) * stray**2 + (HALF_STEP / value) ** 2
    found = left * unknown / (grain + unknown)
    return share, found + found[:, [known.lead]] * ~first


def _soft_light(
    scene: ShadedImage, solution: Solution, lamps: FloatArray, colours: LightColours, surface: ShadowMap
) -> tuple[EnvironmentLight, FloatArray]:
    """Return the environment, and its light (N, 3) on texels, with what their `surface` throws onto itself.

    `lamps` (L, N) is the light of the lamps, of which it throws too; the colours are in their order.
    """
    model, mask, caster = solution.model, scene.image.mask, scene.shadows[0]
    fill, albedo, own = model.soft(solution.x)
    occluded, waves = caster is not None, np.vstack([colours.ambient, own[:, None] + colours.harmonics])
    environment = EnvironmentLight(waves, occluded=occluded, fill=fill, bounce=albedo)
    light = harmonics(surface.normal, 2) @ open_shading(environment)
    for name, part in PARTS.items():
        if part.basis is not None and model.has(name):
            light += (part.basis(surface) @ model.part(solution.x, name))[:, None] * colours.ambient
    if caster is None:
        return environment, light
    # What the surface hides and what it throws back changes slowly along it, and comes from cells.
    finest = scene.at(scene.options.sizes[2])
    level, terms = finest.level, finest.soft
    hidden = open_transfer(level.normal) - terms.transfer
    hidden[:, 0] *= 1 - fill
    change = -hidden @ waves
    if terms.bounce is not None and albedo:
        direct = cell_means(level, lamps.sum(0), mask) + terms.linear(model, solution.x)
        change += albedo * terms.bounce(direct)[:, None] * colours.bounce
    return environment, light + along_surface(level, change, scene.image)
