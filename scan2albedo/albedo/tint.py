"""The colours of a light's parts, and what they do to the colours of a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.albedo.light_colour import solve_colours
from scan2albedo.albedo.light_parameters import HARMONICS, Solution
from scan2albedo.albedo.residual_objective import ResidualProblem
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.plan import PlanStep


@dataclass(frozen=True)
class Tint:
    """`colors` (K, 3) of the parts of a solution's light, in the order of `SoftTerms.columns`."""

    solution: Solution
    colors: FloatArray
    step: PlanStep

    @classmethod
    def of(cls, problem: ResidualProblem, solution: Solution, choice: bool | None = None) -> Tint:
        """Solve the colours on the cells of `problem`, which has no guide."""
        point = problem.at(solution.model, solution.x)
        columns = point.columns().T
        white = np.ones(columns.shape[1])
        known = problem.level.color, point.highlight(), problem.weight, problem.blocks
        found = solve_colours(columns, white, *known, choice=choice)
        return cls(solution, found.colors, found.step)


def tint_on(problem: ResidualProblem, tint: Tint | None, found: Solution | None = None) -> FloatArray | None:
    """Return (N, 3) by what the light multiplies the colours of the cells; None for white light.

    Light that bounced in the solution `found` has the mean colour of the surface.
    """
    by_light = None
    if tint is not None and not (tint.colors == 1).all():
        by_light = _ratio(problem, tint.solution, tint.colors)
    if found is None or not found.model.has("bounce"):
        return by_light
    colors = np.ones((found.model.lights + HARMONICS + 2, 3))
    mean = np.average(problem.level.color, axis=0, weights=problem.level.weight)
    colors[-1] = mean / mean.max()
    by_bounce = _ratio(problem, found, colors)
    return by_bounce if by_light is None else by_light * by_bounce


def _ratio(problem: ResidualProblem, solution: Solution, colors: FloatArray) -> FloatArray:
    """Return (N, 3) the light in these colours (K, 3) of its parts as multiples of white light."""
    columns = problem.at(solution.model, solution.x).columns()
    return np.asarray(np.maximum(columns.T @ colors, DARKEST) / np.maximum(columns.sum(0), DARKEST)[:, None])
