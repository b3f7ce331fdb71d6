"""The image whose light is sought, at the sizes of the search, and what a search finds."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from scan2albedo.albedo.levels import Level, brightest_around, build_level, cell_means
from scan2albedo.albedo.light_colour import LightColours
from scan2albedo.albedo.light_parameters import LightModel, Solution
from scan2albedo.albedo.node_field import NodeField
from scan2albedo.albedo.options import SHADOW_OFFSET_MM, EstimateOptions
from scan2albedo.albedo.posterior import Point, Posterior
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.albedo.shadows import Horizon, ShadowLattice, shadow_caster
from scan2albedo.albedo.soft_terms import SoftTerms
from scan2albedo.albedo.uncertainty import LightUncertainty
from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.plan import PlanStep
from scan2albedo.geometry.mesh import lengths
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment_light import shadowed_transfer, sky_table
from scan2albedo.lighting.interreflection import Patches
from scan2albedo.lighting.shadow_map import ShadowMap, cone_directions

CONE_RAD = 1.92
"""Half angle around the view direction in which lights are sought: a little behind the face."""
_DIRECTIONS = 60
"""Directions of a lamp of which one step is tried: 22 degrees lie between neighbours."""
_ROUNDS = 5
_LEAST_RESIDUAL = 1e-3


@dataclass(frozen=True)
class Explanation:
    """The best explanation, its colours, and what all of them together say.

    `shift` (N, 3) is what their mean log light adds to the best one's on the cells of `level`, `spread` (N,)
    their standard deviation.
    """

    best: Point
    colours: LightColours
    level: Level
    shift: FloatArray
    spread: FloatArray


@dataclass(frozen=True)
class LightFound:
    """The best solution, the unit of its highlight's strength, the plan's rows, and what casts shadows.

    The paper's search neither says how sure the light is nor how it was explained.
    """

    solution: Solution
    unit: float
    steps: list[PlanStep]
    caster: RayCaster | None
    uncertainty: LightUncertainty | None = None
    explanation: Explanation | None = None


@dataclass(frozen=True)
class LitImage:
    """The input of a search for the light: `usable` is (H, W), `view` a unit vector toward the viewer.

    Texels whose camera is known have a view direction of their own.
    """

    image: GeometryImage
    usable: BoolArray
    brdf: str
    view: tuple[float, float, float]
    options: EstimateOptions
    meter: Meter
    prior: AlbedoPrior
    _levels: dict[int, Level] = field(default_factory=dict, init=False, repr=False)
    _soft: dict[int, SoftTerms] = field(default_factory=dict, init=False, repr=False)
    _cell_places: dict[int, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _lattices: dict[int, ShadowLattice] = field(default_factory=dict, init=False, repr=False)
    _horizons: dict[int, Horizon] = field(default_factory=dict, init=False, repr=False)

    def model(self, lights: int) -> LightModel:
        """Return the plain model of so many lights."""
        radius = float(lengths(self.image.position)[self.image.mask].max()) or 1.0
        return LightModel(lights, self.brdf, self.view, radius)

    def level(self, size: int) -> Level:
        """Return the image with `size` cells along its longer side; known ones are kept."""
        if size not in self._levels:
            self._levels[size] = build_level(self.image, self.usable, size, self.value, self.toward)
        return self._levels[size]

    @cached_property
    def toward(self) -> FloatArray:
        """(P, 3) unit directions from the masked texels to the camera, or the viewer."""
        return self.image.toward_camera(self.view)

    @cached_property
    def places(self) -> FloatArray:
        """(P, 2) where on the prior's chart each masked texel lies: row and column, from 0 to 1."""
        mask, chart = self.image.mask, self.image.face_chart
        if self.prior.face and chart is not None:
            return chart[mask].astype(np.float64)
        return (np.argwhere(mask) + 0.5) / np.asarray(mask.shape)

    def cell_places(self, level: Level) -> FloatArray:
        """Return (N, 2) where on the prior's chart the cells of a level lie; known ones are kept."""
        if level.factor not in self._cell_places:
            means = [cell_means(level, along, self.image.mask) for along in self.places.T]
            self._cell_places[level.factor] = np.stack(means, 1)
        return self._cell_places[level.factor]

    @cached_property
    def nodes(self) -> NodeField:
        """What is known at the nodes of the prior."""
        level = self.level(self.options.sizes[1])
        return NodeField(self.prior, level, self.cell_places(level))

    def posterior(self, size: int, blur: float = 0.0) -> Posterior:
        """Return the posterior of `size` cells, with outlines blurred by a part of the chart's side."""
        level = self.level(size)
        terms = self.lattice(level), self.soft(level)
        return Posterior(level, self.cell_places(level), *terms, self.nodes, self.meter, blur)

    def lattice(self, level: Level) -> ShadowLattice:
        """Return the cast shadows of a level; known ones are kept."""
        if level.factor not in self._lattices:
            horizon = self._horizons.get(level.factor)
            above = None if horizon is None else horizon.at(level.center)
            self._lattices[level.factor] = ShadowLattice(level, self.shadows[0], SHADOW_OFFSET_MM, above)
        return self._lattices[level.factor]

    def soft(self, level: Level) -> SoftTerms:
        """Return what soft light needs to know of a level; known ones are kept."""
        if level.factor in self._soft:
            return self._soft[level.factor]
        caster, patches = self.shadows[0], self._patches
        bounce = None if patches is None else patches.seen_from(level.anchor, level.normal)
        surface = level.anchor, level.normal, SHADOW_OFFSET_MM
        if caster is None:
            self._soft[level.factor] = SoftTerms(shadowed_transfer(ShadowMap(caster, *surface)), bounce)
            return self._soft[level.factor]
        above, middle = None, self.level(self.options.sizes[1])
        if level.factor < middle.factor:
            self.soft(middle)
            above = self._horizons[middle.factor].at(level.center)
        shadows = ShadowMap(caster, *surface, above)
        sky = sky_table(shadows)
        self._horizons[level.factor] = Horizon(level, sky)
        self._soft[level.factor] = SoftTerms(shadowed_transfer(shadows, sky), bounce)
        return self._soft[level.factor]

    def open_above(self) -> FloatArray | None:
        """Return (P,) the cosine above which nothing hides a light from each masked texel, where known."""
        if not self._horizons:
            return None
        return self._horizons[min(self._horizons)].at(np.argwhere(self.image.mask))

    @cached_property
    def _patches(self) -> Patches | None:
        caster, image, mask = self.shadows[0], self.image, self.image.mask
        if caster is None:
            return None
        surface = image.position[mask], image.normal[mask].astype(np.float64)
        return Patches.among(ShadowMap(caster, *surface, SHADOW_OFFSET_MM))

    @cached_property
    def directions(self) -> FloatArray:
        """The directions that are tried, those nearest to where the shading grows first."""
        every = cone_directions(_DIRECTIONS, self.view, CONE_RAD)
        return nearest_first(every, shading_direction(self._smallest))

    @cached_property
    def shadows(self) -> tuple[RayCaster | None, PlanStep]:
        """What casts shadows, and the plan's row."""
        return shadow_caster(self.image, self._smallest, self.directions, self.options, self.meter)

    @property
    def _smallest(self) -> Level:
        return self.level(self.options.sizes[0])

    @cached_property
    def value(self) -> FloatArray:
        """(H, W) the channel that is the brightest around each texel."""
        assert self.image.texture_linear is not None
        return brightest_around(self.image.texture_linear, self.usable)


def shading_direction(level: Level) -> FloatArray:
    """Return the unit direction in which the cells grow bright, +z where nothing grows.

    V ~ a + b . n in L1, reweighted a few times [1]_.

    .. [1] R. Basri, D. Jacobs, "Lambertian Reflectance and Linear Subspaces", PAMI 25(2), 2003.
    """
    basis = np.column_stack([np.ones(len(level.normal)), level.normal])
    weight: FloatArray = level.weight
    found: FloatArray = np.zeros(4)
    for _ in range(_ROUNDS):
        scaled = basis * weight[:, None]
        found = np.asarray(np.linalg.lstsq(scaled.T @ basis, scaled.T @ level.value, rcond=None)[0], float)
        weight = level.weight / np.maximum(np.abs(basis @ found - level.value), _LEAST_RESIDUAL)
    length = float(np.linalg.norm(found[1:]))
    return found[1:] / length if length > _LEAST_RESIDUAL else np.array([0.0, 0.0, 1.0])


def nearest_first(directions: FloatArray, toward: FloatArray) -> FloatArray:
    """Return the directions (D, 3), those nearest to `toward` first.

    >>> nearest_first(np.eye(3), np.array([0.0, 1.0, 0.0]))[0]
    array([0., 1., 0.])
    """
    return directions[np.argsort(-(directions @ toward), kind="stable")]
