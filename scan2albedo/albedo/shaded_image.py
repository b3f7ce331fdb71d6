"""The image whose light is sought, at the sizes of the search, and what a search finds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from scan2albedo.albedo.levels import Level, brightest_around, build_level, cell_means
from scan2albedo.albedo.light_colour import LightColours
from scan2albedo.albedo.light_parameters import PARTS, LightModel, Solution
from scan2albedo.albedo.node_field import NodeField
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.posterior import Point, Posterior
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.albedo.shadows import Horizon, ShadowLattice, shadow_caster
from scan2albedo.albedo.soft_terms import SoftTerms
from scan2albedo.albedo.uncertainty import LightUncertainty
from scan2albedo.core import GeometryImage, Meter, PlanStep
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.mesh import lengths
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.environment_light import SKY, Patches, shadowed_transfer
from scan2albedo.lighting.shadow_map import ShadowMap, VisibilityTable, cone_directions

CONE_RAD = 1.92
"""Half angle around the view direction in which lights are sought: a little behind the face."""
_DIRECTIONS = 60
"""Directions of a lamp of which one step is tried: 22 degrees lie between neighbours."""
_LEAST_RESIDUAL = 1e-3


@dataclass(frozen=True)
class Explanation:
    """The best explanation, its colours, and, on the N cells of `level`, what all of them together say.

    `shift` (N,) is what their mean log light adds to the best one's, `spread` (N,) their deviation.
    """

    best: Point
    colours: LightColours
    level: Level
    shift: FloatArray
    spread: FloatArray


@dataclass(frozen=True)
class LightFound:
    """The best solution, the plan's rows, and, but for the paper's search, how sure it is and why."""

    solution: Solution
    steps: list[PlanStep]
    uncertainty: LightUncertainty | None = None
    explanation: Explanation | None = None


@dataclass(frozen=True)
class ShadedImage:
    """The input of a search for the light: `usable` is (H, W), `view` a unit vector toward the viewer."""

    image: GeometryImage
    usable: BoolArray
    brdf: str
    view: tuple[float, float, float]
    options: EstimateOptions
    meter: Meter
    prior: AlbedoPrior
    _sized: dict[int, SizedImage] = field(default_factory=dict, init=False, repr=False)

    def model(self, lights: int, parts: Iterable[str] = ()) -> LightModel:
        """Return the model of so many lights, with `parts` but for those that caller or surface leave out."""
        left_out = {part for part in parts if self.options.choice(PARTS[part].stage) is False}
        if parts and self.shadows[0] is None:
            left_out |= {"occlusion", "bounce"}
        radius = float(lengths(self.image.position)[self.image.mask].max()) or 1.0
        return LightModel(lights, self.brdf, self.view, radius, frozenset(parts) - left_out)

    def at(self, size: int) -> SizedImage:
        """Return the image with `size` cells along its longer side; known ones are kept."""
        if size not in self._sized:
            self._sized[size] = SizedImage(self, size)
        return self._sized[size]

    def posterior(self, size: int, blur: float = 0.0) -> Posterior:
        """Return the posterior of `size` cells, with outlines blurred by a part of the chart's side."""
        cells = self.at(size)
        if blur not in cells.posteriors:
            parts = cells.level, cells.places, cells.lattice, cells.soft
            cells.posteriors[blur] = Posterior(*parts, self.nodes, self.meter, blur)
        return cells.posteriors[blur]

    @cached_property
    def toward(self) -> FloatArray:
        """(P, 3) unit directions from the masked texels to the camera, or the viewer."""
        return self.image.toward_camera(self.view)

    @cached_property
    def places(self) -> FloatArray:
        """(P, 2) where on the prior's chart each masked texel lies: row and column, from 0 to 1."""
        mask, chart = self.image.mask, self.image.face_chart
        if self.prior.face and chart is not None:
            return chart[mask].astype(float)
        return (np.argwhere(mask) + 0.5) / np.asarray(mask.shape)

    @cached_property
    def nodes(self) -> NodeField:
        """What is known at the nodes of the prior."""
        middle = self.at(self.options.sizes[1])
        return NodeField(self.prior, middle.level, middle.places)

    @cached_property
    def patches(self) -> Patches | None:
        """What throws light onto the surface, where anything casts shadows."""
        caster, image, mask = self.shadows[0], self.image, self.image.mask
        if caster is None:
            return None
        surface = image.position[mask], image.normal[mask].astype(float)
        return Patches.among(ShadowMap(caster, *surface))

    @cached_property
    def directions(self) -> FloatArray:
        """The directions that are tried, those nearest to where the shading grows first."""
        every = cone_directions(_DIRECTIONS, self.view, CONE_RAD)
        toward = shading_direction(self.at(self.options.sizes[0]).level)
        return every[np.argsort(-(every @ toward), kind="stable")]

    @cached_property
    def shadows(self) -> tuple[RayCaster | None, PlanStep]:
        """What casts shadows, and the plan's row."""
        level = self.at(self.options.sizes[0]).level
        return shadow_caster(self.image, level, self.directions, self.options, self.meter)

    @cached_property
    def value(self) -> FloatArray:
        """(H, W) the channel that is the brightest around each texel."""
        assert self.image.texture_linear is not None
        return brightest_around(self.image.texture_linear, self.usable)


class SizedImage:
    """The N cells of an image at one size, and what a search needs to know of them, made when asked for."""

    def __init__(self, scene: ShadedImage, size: int) -> None:
        self.scene, self.posteriors = scene, dict[float, Posterior]()
        self.level = build_level(scene.image, scene.usable, size, scene.value, scene.toward)

    @cached_property
    def places(self) -> FloatArray:
        """(N, 2) where on the prior's chart the cells lie."""
        mask, places = self.scene.image.mask, self.scene.places
        return np.stack([cell_means(self.level, along, mask) for along in places.T], 1)

    @cached_property
    def lattice(self) -> ShadowLattice:
        """Their cast shadows."""
        return ShadowLattice(self.level, self.scene.shadows[0])

    @cached_property
    def _shadows(self) -> ShadowMap:
        """Exact rays; finer cells know from those of the middle size where none is needed."""
        scene, level, above = self.scene, self.level, None
        middle = scene.at(scene.options.sizes[1])
        if scene.shadows[0] is not None and level.factor < middle.level.factor:
            above = middle.horizon.at(level.center)
        return ShadowMap(scene.shadows[0], level.anchor, level.normal, open_above=above)

    @cached_property
    def _sky(self) -> VisibilityTable:
        return self._shadows.table(distant_directions(SKY))

    @cached_property
    def horizon(self) -> Horizon:
        """Above which no light is hidden from them."""
        return Horizon(self.level, self._sky)

    @cached_property
    def soft(self) -> SoftTerms:
        """What soft light does to them."""
        level, patches = self.level, self.scene.patches
        bounce = None if patches is None else patches.seen_from(level.anchor, level.normal)
        others = {name: part.basis(self._shadows) for name, part in PARTS.items() if part.basis is not None}
        return SoftTerms(shadowed_transfer(self._shadows, self._sky), bounce, others)


def shading_direction(level: Level) -> FloatArray:
    """Return the unit direction in which the cells grow bright, +z where nothing grows.

    V ~ a + b . n in L1, reweighted a few times [1]_.

    .. [1] R. Basri, D. Jacobs, "Lambertian Reflectance and Linear Subspaces", PAMI 25(2), 2003.
    """
    basis = np.column_stack([np.ones(len(level.normal)), level.normal])
    weight, found = level.weight, np.zeros(4)
    for _ in range(5):
        scaled = basis * weight[:, None]
        found = np.asarray(np.linalg.lstsq(scaled.T @ basis, scaled.T @ level.value, rcond=None)[0], float)
        weight = level.weight / np.maximum(np.abs(basis @ found - level.value), _LEAST_RESIDUAL)
    length = float(np.linalg.norm(found[1:]))
    return found[1:] / length if length > _LEAST_RESIDUAL else np.array([0.0, 0.0, 1.0])
