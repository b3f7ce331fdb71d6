"""The unknowns of the light as a vector for an optimiser, and back; solutions of its search."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from scan2albedo.core import PointLight
from scan2albedo.core.arrays import FloatArray, NDArray
from scan2albedo.lighting.shading import DIFFUSE_MODELS, Parameter, Reflectance, light_from_direction
from scan2albedo.lighting.shadow_map import ShadowMap, view_frame

HARMONICS = 8
"""Harmonics of the environment beside the constant one: orders 1 and 2."""


@dataclass(frozen=True)
class Hypothesis:
    """One state of the light: `rows` (L, 5) of direction, 1/distance, intensity; one radius for all lamps."""

    rows: FloatArray
    reflectance: Reflectance
    radius_deg: float = 0.0

    def lights(self) -> tuple[PointLight, ...]:
        """Return the lights, strongest first."""
        order, found = np.argsort(-self.rows[:, 4], kind="stable"), list[PointLight]()
        for row in self.rows[order]:
            lamp = light_from_direction(row[:3], float(1 / row[3]) if row[3] > 0 else math.inf, row[4])
            found.append(replace(lamp, radius_deg=self.radius_deg))
        return tuple(found)


@dataclass(frozen=True)
class LightPart:
    """An optional part of the light, its stage of the plan, and its parameters, each with a normal prior."""

    stage: str
    parameters: tuple[Parameter, ...] = ()
    """A part of which only the first parameter can be nothing has NaN as `plain` of the others."""
    of_lamps: bool = False
    """Whether it is free only where there is a lamp."""
    basis: Callable[[ShadowMap], FloatArray] | None = None
    """Gives (N, K) the light on the points of a map for each of K parameters, which it is linear in."""


_DIRECTION = Parameter(0.0, -1.95, 1.95, 0.12, 0.0, math.inf)
INTENSITY = Parameter(0.0, math.log(0.02), math.log(20.0), 0.3, math.log(1.5), 1.2)
"""Log of a lamp's strength beside the ambient light: from a dim fill to a flash in a dark room."""
NEAR = Parameter(0.1, 0.0, 0.6, 0.1, 0.0, 0.06)
"""The face's radius by the lamp's distance: lamps stand a metre away and more."""
GLOSS = Parameter(0.05, 0.0, 2.0, 0.08, 0.057, 0.47)
"""Phong's strength. The mean is that on skin of albedo 1: Beckmann's lobe of roughness .35 and index 1.4
(Fresnel .028) seen along the normal, .028 / (4 .35^2) [1]_; and the deviation is what its log errs by beside
the prior's level of skin, which is 0.52 off for heads whose group is left out, 0.22 for others.

.. [1] T. Weyrich et al., "Analysis of human faces using a measurement-based skin reflectance model", SIGGRAPH
   2006.
"""
EXPONENT = Parameter(
    math.log(Reflectance.exponent), math.log(4.0), math.log(200.0), 0.6, math.log(6.0), 0.4, math.nan
)
"""Log exponent of that lobe of skin."""
FILL = Parameter(0.5, 0.0, 1.0, 0.2, 0.3, 0.2, 1.0)
"""Part of the hidden ambient light that comes back from elsewhere."""
BOUNCE = Parameter(0.3, 0.0, 0.9, 0.1, 0.0, 0.1)
"""The albedo that bounces light, around what the colour of skin says."""
_FIRST_ORDER = Parameter(0.0, -1.8, 1.8, 0.1, 0.0, 0.35)
"""A harmonic beside the constant one: natural light falls so from order to order [1]_.

.. [1] R. Dror, A. Willsky, E. Adelson, "Statistical characterization of real-world illumination", J. Vision
   4, 2004.
"""
_SECOND_ORDER = _FIRST_ORDER._replace(deviation=0.15)

PARTS = {
    "near": LightPart("albedo.near_light", (NEAR,), of_lamps=True),
    "rough": LightPart("albedo.roughness", of_lamps=True),
    "specular": LightPart("albedo.specular", (GLOSS, EXPONENT), of_lamps=True),
    "occlusion": LightPart("albedo.occlusion", (FILL,)),
    "bounce": LightPart("albedo.bounce", (BOUNCE,)),
    "environment": LightPart("albedo.environment", (_FIRST_ORDER,) * 3 + (_SECOND_ORDER,) * 5),
}
"""The optional parts by their names. Another one with a `basis` is one more entry; the parameters of "rough"
are those of the diffuse model."""


@dataclass(frozen=True)
class LightModel:
    """Which parameters are free, and how a vector x holds them.

    x = [p_x, p_y, log intensity] of each lamp, then the parameters of those of `PARTS` that `parts` names and
    that a lamp is there for. p is the direction in exponential coordinates around `view`, |p| the angle from
    it: without a pole among the directions that light a face. `radius_mm`, the largest distance of the
    surface from the origin, is the unit of the lamps' common distance.
    """

    lights: int
    brdf: str
    view: tuple[float, float, float]
    radius_mm: float
    parts: frozenset[str] = field(default_factory=frozenset)
    radius_deg: float = 0.0

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where in x each free part is."""
        found = dict[str, slice]()
        first = 3 * self.lights
        for name, part in PARTS.items():
            count = len(self._parameters(name))
            if name in self.parts and count and (self.lights or not part.of_lamps):
                found[name] = slice(first, first + count)
                first += count
        return found

    def _parameters(self, name: str) -> tuple[Parameter, ...]:
        roughness = DIFFUSE_MODELS[self.brdf].roughness
        own = () if roughness is None else (roughness,)
        return own if name == "rough" else PARTS[name].parameters

    @cached_property
    def table(self) -> NDArray:
        """(P,) what is known of each parameter, by the fields of `Parameter`."""
        rows = [_DIRECTION, _DIRECTION, INTENSITY] * self.lights
        for name in self.slices:
            rows += self._parameters(name)
        return np.array(rows, [(name, float) for name in Parameter._fields])

    def part(self, x: FloatArray, name: str) -> FloatArray:
        """Return the parameters of a part, those of light without it where it is not free."""
        if name in self.slices:
            return x[self.slices[name]]
        rows = self._parameters(name)
        return np.array([row.start if math.isnan(row.plain) else row.plain for row in rows])

    @cached_property
    def _frame(self) -> FloatArray:
        return view_frame(self.view)

    @property
    def size(self) -> int:
        """Length of x."""
        return len(self.table["start"])

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return (lower, upper) of x."""
        return self.table["lower"], self.table["upper"]

    def from_lights(self, directions: FloatArray, intensities: FloatArray) -> FloatArray:
        """Return x of lights in `directions` (L, 3), everything else at its start."""
        head = [[*self.coordinates(d), math.log(e)] for d, e in zip(directions, intensities, strict=True)]
        return np.append(head, self.table["start"][3 * self.lights :])

    def coordinates(self, direction: FloatArray) -> tuple[float, float]:
        """Return p of a unit direction (3,)."""
        x, y, z = self._frame @ direction
        across = math.hypot(x, y)
        angle = math.atan2(across, z)
        return (angle * x / across, angle * y / across) if across > 0 else (angle, 0.0)

    def direction(self, px: float, py: float) -> FloatArray:
        """Return the unit direction (3,) of p."""
        return _with_tangents(px, py)[0] @ self._frame

    def tangents(self, x: FloatArray) -> FloatArray:
        """Return (L, 2, 3) the derivatives of each light's direction by p."""
        found = [_with_tangents(px, py)[1:] for px, py, _ in x[: 3 * self.lights].reshape(-1, 3).tolist()]
        return np.reshape(found, (self.lights, 2, 3)) @ self._frame

    def decode(self, x: FloatArray) -> Hypothesis:
        """Return the hypothesis that x stands for (x clipped to the bounds)."""
        x = np.clip(x, *self.bounds)
        lamps = x[: 3 * self.lights].reshape(-1, 3).tolist()
        nearness = float(self.part(x, "near")[0]) / self.radius_mm
        rows = [[*self.direction(px, py), nearness, math.exp(log_e)] for px, py, log_e in lamps]
        roughness = float(self.part(x, "rough").sum()) ** DIFFUSE_MODELS[self.brdf].power
        strength, exponent = self.part(x, "specular").tolist()
        reflectance = Reflectance(self.brdf, roughness, strength, math.exp(exponent))
        return Hypothesis(np.reshape(rows, (-1, 5)), reflectance, self.radius_deg)

    def soft(self, x: FloatArray) -> tuple[float, float, FloatArray]:
        """Return soft light relative to ambient light of 1: its part that reaches hidden places, the mean
        albedo by which the surface lights itself, and the environment's harmonics (8,).
        """
        fill, albedo = self.part(x, "occlusion")[0], self.part(x, "bounce")[0]
        return float(fill), float(albedo), self.part(x, "environment")

    def without(self, part: str) -> LightModel:
        """Return the model in which a part is not free."""
        return replace(self, parts=self.parts - {part})

    def has(self, part: str) -> bool:
        """Return whether a part is free: of lamps only where there is one."""
        return part in self.slices

    def extend(self, x: FloatArray, other: LightModel) -> FloatArray:
        """Return x of `other`, which may have more lamps and other free parts, at the same state."""
        found = other.table["start"].copy()
        found[: 3 * self.lights] = x[: 3 * self.lights]
        for name, place in other.slices.items():
            if self.has(name):
                found[place] = x[self.slices[name]]
        return found


def _with_tangents(px: float, py: float) -> list[list[float]]:
    """Return the unit direction of p in the frame of the view, and its derivatives by p."""
    angle = math.hypot(px, py)
    if angle < 1e-6:
        return [[px, py, 1.0], [1.0, 0.0, -px], [0.0, 1.0, -py]]
    part = math.sin(angle) / angle
    # (sin a / a)' / a
    bend = (math.cos(angle) - part) / angle**2
    return [
        [part * px, part * py, math.cos(angle)],
        [part + bend * px * px, bend * px * py, -part * px],
        [bend * px * py, part + bend * py * py, -part * py],
    ]


@dataclass(frozen=True)
class Solution:
    """A model, its parameters and their cost."""

    model: LightModel
    x: FloatArray
    cost: float

    @property
    def hypothesis(self) -> Hypothesis:
        """The state of the light."""
        return self.model.decode(self.x)
