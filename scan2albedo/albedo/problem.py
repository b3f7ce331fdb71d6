"""The objective at one image size: hypotheses in, costs out, every evaluation counted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.light_model import Hypothesis, LightModel
from scan2albedo.albedo.objective import KINDS, evaluate
from scan2albedo.core import Meter
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import ShadowMap, VisibilityTable

FloatArray = NDArray[np.float64]


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


class Problem:
    """The objective over one `Level`.

    Parameters
    ----------
    level : Level
    caster : RayCaster, optional
        Casts shadows; None leaves them out.
    view : (3,) float64
        Unit direction to the viewer.
    objective : str
        Name of the objective, see `EstimateOptions`.
    offset_mm : float
        Of shadow rays.
    meter : Meter
        Counts the evaluations.
    direction_step : float
        Shadows are computed for lights rounded to this step (of a unit direction, and of the surface's
        extent over the distance) and kept, so that a local search rarely shoots rays.
    """

    def __init__(
        self,
        level: Level,
        caster: RayCaster | None,
        view: FloatArray,
        objective: str,
        offset_mm: float,
        meter: Meter,
        direction_step: float,
    ) -> None:
        self.level, self.meter = level, meter
        self._view, self._kind = view, KINDS[objective]
        self._shadows = None if caster is None else ShadowMap(caster, level.anchor, level.normal, offset_mm)
        self._light, self._specular = np.empty_like(level.value), np.empty_like(level.value)
        self._step, self._radius = direction_step, float(np.linalg.norm(level.position, axis=1).max()) or 1.0
        self._known: dict[tuple[int, ...], NDArray[np.uint8]] = {}
        self._all_visible = np.ones((4, len(level.value)), np.uint8)

    def visibility(self, rows: FloatArray) -> NDArray[np.uint8]:
        """Return (L, N) the visibility of the lights in `rows` (L, 5) by rays."""
        if self._shadows is None:
            return self._all_visible[: len(rows)]
        return np.stack([self._reached(row) for row in rows])

    def _reached(self, row: FloatArray) -> NDArray[np.uint8]:
        """Return (N,) the visibility of the light nearest to `row` on the lattice of lights."""
        assert self._shadows is not None
        lattice = np.round(np.append(row[:3], row[3] * self._radius) / self._step)
        key = tuple(lattice.astype(int).tolist())
        if key not in self._known:
            direction, nearness = lattice[:3] * self._step, lattice[3] * self._step / self._radius
            distance = 1 / nearness if nearness > 0 else math.inf
            self._known[key] = self._shadows.visible(direction / np.linalg.norm(direction), distance)
        return self._known[key]

    def cost(self, hypothesis: Hypothesis, visible: NDArray[np.uint8] | None = None) -> float:
        """Return the objective and count it; `visible` (L, N) saves the rays."""
        self.meter.count()
        return self.evaluate(hypothesis, visible)

    def evaluate(self, hypothesis: Hypothesis, visible: NDArray[np.uint8] | None = None) -> float:
        """Return the objective, which the caller counts."""
        level, reflectance = self.level, hypothesis.reflectance
        return evaluate(
            self._kind,
            level.position,
            level.normal,
            self.visibility(hypothesis.rows) if visible is None else visible,
            level.value,
            level.weight,
            level.scale,
            level.blocks,
            level.block_count,
            hypothesis.rows,
            self._view,
            reflectance.kernel_brdf,
            reflectance.roughness,
            reflectance.specular_strength,
            reflectance.exponent,
            self._light,
            self._specular,
        )

    def table(self, directions: FloatArray) -> VisibilityTable:
        """Return the visibility of distant lights from `directions` (D, 3)."""
        if self._shadows is None:
            shape = (len(directions), len(self.level.value))
            return VisibilityTable(directions, np.ones(shape, np.uint8))
        return self._shadows.table(directions)


def cost_removed(cost: float, before: float) -> float:
    """Return which part of the cost `before` is gone at `cost`; 0 where there was nothing to remove."""
    return 1 - cost / before if before > 0 else 0.0


@dataclass(frozen=True)
class Yardstick:
    """One measure for a search that works at several image sizes: the cost on the finest.

    Costs at different sizes do not compare, so the trace holds this one only.

    Parameters
    ----------
    meter : Meter
    cost : callable
        Returns a solution's cost on the finest image and counts the evaluation.
    """

    meter: Meter
    cost: Callable[[Solution], float]

    def record(self, solution: Solution) -> None:
        """Add a trace row with the cost of what would be the answer now, while the budget lasts."""
        if not (self.meter.exhausted and self.meter.rows):
            self.meter.record(self.cost(solution))
