"""The unknowns of the light as a vector for an optimiser, and back; solutions of its search."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scan2albedo.core import PointLight
from scan2albedo.core.arrays import FloatArray
from scan2albedo.lighting.shading import Reflectance, light_from_direction
from scan2albedo.lighting.shadow_map import view_frame

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
class LightModel:
    """Which parameters are free, and how a vector x holds them.

    x = [p_x, p_y, log intensity] of each lamp, then, where free, radius/distance, roughness, (specular
    strength, log exponent), fill, bounce, eight harmonics. p is the direction in exponential coordinates
    around `view`, |p| the angle from it: without a pole among the directions that light a face. `radius_mm`,
    the largest distance of the surface from the origin, is the unit of the lamps' common distance. `near`,
    `rough`, `specular` free the distance, the roughness, the highlight, where there are lamps; `occlusion`,
    `bounce`, `environment` what `SoftTerms` says of soft light.
    """

    lights: int
    brdf: str
    view: tuple[float, float, float]
    radius_mm: float
    near: bool = False
    rough: bool = False
    specular: bool = False
    occlusion: bool = False
    bounce: bool = False
    environment: bool = False
    radius_deg: float = 0.0

    @cached_property
    def _tail(self) -> dict[str, tuple[float, float, float, float]]:
        """Start, bounds and first step of the parameters after the lights; a part's first has its name."""
        rows = {}
        if self.near and self.lights:
            rows["near"] = 0.1, 0.0, 0.6, 0.1
        if self.rough and self.lights:
            rows["rough"] = (1.0, 0.3, 2.0, 0.2) if self.brdf == "minnaert" else (0.04, 0.0, 1.0, 0.04)
        if self.specular and self.lights:
            rows["specular"] = 0.05, 0.0, 2.0, 0.08
            rows["exponent"] = math.log(Reflectance.exponent), math.log(4.0), math.log(200.0), 0.6
        if self.occlusion:
            rows["occlusion"] = 0.5, 0.0, 1.0, 0.2
        if self.bounce:
            rows["bounce"] = 0.3, 0.0, 0.9, 0.1
        if self.environment:
            names = "environment", *(f"harmonic{k}" for k in range(2, HARMONICS + 1))
            rows |= dict.fromkeys(names, (0.0, -1.8, 1.8, 0.1))
        return rows

    def _values(self, x: FloatArray) -> dict[str, float]:
        return dict(zip(self._tail, x[3 * self.lights :].tolist(), strict=True))

    @cached_property
    def _frame(self) -> FloatArray:
        return view_frame(self.view)

    @property
    def size(self) -> int:
        """Length of x."""
        return 3 * self.lights + len(self._tail)

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return (lower, upper) of x."""
        tail = self._tail.values()
        lower = [-1.95, -1.95, math.log(0.02)] * self.lights + [row[1] for row in tail]
        upper = [1.95, 1.95, math.log(20.0)] * self.lights + [row[2] for row in tail]
        return np.array(lower), np.array(upper)

    def steps(self) -> FloatArray:
        """Return first step lengths of x."""
        return np.array([0.12, 0.12, 0.3] * self.lights + [row[3] for row in self._tail.values()])

    def from_lights(self, directions: FloatArray, intensities: FloatArray) -> FloatArray:
        """Return x of lights in `directions` (L, 3), everything else at its start."""
        head = [[*self.coordinates(d), math.log(e)] for d, e in zip(directions, intensities, strict=True)]
        return np.array([*np.ravel(head), *(row[0] for row in self._tail.values())], float)

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
        tail, lamps = self._values(x), x[: 3 * self.lights].reshape(-1, 3).tolist()
        nearness = tail.get("near", 0.0) / self.radius_mm
        rows = [[*self.direction(px, py), nearness, math.exp(log_e)] for px, py, log_e in lamps]
        roughness = tail.get("rough", 1.0) if self.brdf == "minnaert" else math.sqrt(tail.get("rough", 0.0))
        exponent = math.exp(tail.get("exponent", math.log(Reflectance.exponent)))
        reflectance = Reflectance(self.brdf, roughness, tail.get("specular", 0.0), exponent)
        return Hypothesis(np.reshape(rows, (-1, 5)), reflectance, self.radius_deg)

    def soft(self, x: FloatArray) -> tuple[float, float, FloatArray]:
        """Return soft light relative to ambient light of 1: its part that reaches hidden places, the mean
        albedo by which the surface lights itself, and the environment's harmonics (8,).
        """
        tail, harmonics = self._values(x), np.zeros(HARMONICS)
        if self.environment:
            harmonics = x[self.position_of("environment") :][:HARMONICS]
        return tail.get("occlusion", 1.0), tail.get("bounce", 0.0), harmonics

    def position_of(self, part: str) -> int:
        """Return where in x a part is, its first parameter; ValueError when it is not free."""
        return 3 * self.lights + list(self._tail).index(part)

    def has(self, part: str) -> bool:
        """Return whether a part is free: of lamps only where there is one."""
        return part in self._tail

    def extend(self, x: FloatArray, other: LightModel) -> FloatArray:
        """Return x of `other`, which has the same lights and more or fewer free parts, at the same state."""
        mine = self._values(x)
        tail = [mine.get(name, row[0]) for name, row in other._tail.items()]
        return np.concatenate([x[: 3 * self.lights], tail])


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


PARTS = {
    "rough": "albedo.roughness",
    "near": "albedo.near_light",
    "specular": "albedo.specular",
    "occlusion": "albedo.occlusion",
    "bounce": "albedo.bounce",
    "environment": "albedo.environment",
}
"""Stages of the optional parts, by the name of their field of `LightModel`."""
