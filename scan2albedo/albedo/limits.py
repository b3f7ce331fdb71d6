"""Whether the light found lies at an end of what is searched, or leaves light in the albedo."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.problem import Solution
from scan2albedo.core.plan import PlanStep

FloatArray = NDArray[np.float64]

_BRIGHTEST, _GLARING = 99.8, 4.0
"""Percentile of the albedo, and how many times the median it has to be, to be told."""
_NEAR = 1e-3
"""Part of a parameter's range that counts as its end."""


def limits_step(solution: Solution, albedo: FloatArray) -> PlanStep:
    """Return the plan's row that tells which parameters of the light are at an end of their range.

    There a better light may lie beyond: an ambient light too weak to be seen, a lamp that touches the skin,
    no light at all. Light that is no part of the model stays in the albedo: where the brightest 0.2 % of
    it is many times its median, that is told as well.

    Parameters
    ----------
    solution : Solution
    albedo : (N,) float64
        V of the albedo where it was measured.
    """
    at_end = _at_end(solution.model, solution)
    median, brightest = np.percentile(albedo, (50, _BRIGHTEST))
    if brightest > _GLARING * median > 0:
        at_end.append(
            f"the brightest {100 - _BRIGHTEST:.1f} % of the albedo is {brightest / median:.0f} times its "
            "median: is a lamp too near to be modelled, or white on black?"
        )
    if not at_end:
        return PlanStep("albedo.limits", False, "the light lies within what is searched", "no limit reached")
    return PlanStep("albedo.limits", True, "the light lies at an end of what is searched", "; ".join(at_end))


def _at_end(model: LightModel, solution: Solution) -> list[str]:
    lower, upper = model.bounds
    told = []
    for k in range(model.lights):
        i = 3 * k + 2
        if end := _end(float(solution.x[i]), float(lower[i]), float(upper[i])):
            bound = math.exp(lower[i] if end == "least" else upper[i])
            told.append(f"light {k + 1} has the {end} intensity, {bound:.3g} times the ambient light")
    if model.near:
        i = model.position_of("near")
        if solution.x[i] >= upper[i] * (1 - _NEAR):
            told.append(f"the lights have the least distance, {model.radius_mm / upper[i]:.3g} mm")
    return told


def _end(value: float, lower: float, upper: float) -> str:
    """Return "least", "greatest" or "" for within."""
    margin = _NEAR * (upper - lower)
    return "least" if value <= lower + margin else "greatest" if value >= upper - margin else ""
