"""One more light: where it may stand, and whether it is worth it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.parts import albedo_change
from scan2albedo.albedo.problem import Solution, cost_removed
from scan2albedo.albedo.residual_problem import ResidualProblem

FloatArray = NDArray[np.float64]

_ADDED_STRENGTH = 0.4
"""Intensity at which the directions of one more light are tried."""
_SPLIT_RAD = 0.2, 0.4
"""Half the angles between the two lights that replace one."""


@dataclass(frozen=True)
class Verdict:
    """What one more light brings.

    Parameters
    ----------
    gain : float
        Part of the cost that it removes.
    pays : bool
        Whether it is worth it.
    one_or_two : bool
        Whether it would be, but stands so close to another that the two may be one broad light.
    evidence : str
        All that was measured, beside what is asked.
    """

    gain: float
    pays: bool
    one_or_two: bool
    evidence: str


def starts_with_one_more(fewer: Solution, directions: FloatArray) -> Iterable[FloatArray]:
    """Yield starts with one more light: a weak one from every direction, and each light split in two."""
    model = replace(fewer.model, lights=fewer.model.lights + 1)
    rows = fewer.hypothesis.rows
    tail = fewer.x[3 * fewer.model.lights :]

    def start(toward: FloatArray, intensities: FloatArray) -> FloatArray:
        x = model.from_lights(toward, intensities)
        x[3 * model.lights :] = tail
        return x

    for direction in directions:
        yield start(np.vstack([rows[:, :3], direction]), np.append(rows[:, 4], _ADDED_STRENGTH))
    for k in range(len(rows)):
        others = np.delete(rows, k, 0)
        p = fewer.x[3 * k : 3 * k + 2]
        for half, angle in product(_SPLIT_RAD, np.arange(4) * math.pi / 4):
            shift = half * np.array([math.cos(angle), math.sin(angle)])
            pair = np.stack([model.direction(*(p + shift)), model.direction(*(p - shift))])
            yield start(
                np.vstack([others[:, :3], pair]), np.append(others[:, 4], np.repeat(rows[k, 4] / 2, 2))
            )


def without_weakest(solution: Solution) -> FloatArray:
    """Return x of one light less."""
    lights = solution.model.lights
    weakest = int(np.argmin(solution.hypothesis.rows[:, 4]))
    return np.delete(solution.x, slice(3 * weakest, 3 * weakest + 3)) if lights > 1 else solution.x


def judged(problem: ResidualProblem, more: Solution, fewer: Solution, options: EstimateOptions) -> Verdict:
    """Judge a solution with one more light beside one with fewer, both optima of `problem`.

    It pays when it removes enough of the cost, changes the albedo, is not far weaker than the strongest, and
    its direction is known: what is no lamp has none.
    """
    gain = cost_removed(more.cost, fewer.cost)
    intensities = more.hypothesis.rows[:, 4]
    share = float(intensities.min() / intensities.max())
    effect = albedo_change(problem, more, fewer)
    closest, spread = _smallest_angle(more), _direction_deviation(problem, more)
    pays = (
        gain >= options.light_gain
        and share >= options.light_share
        and effect >= options.light_effect
        and spread <= options.light_direction_rad
    )
    # One broad light, or two: the picture does not tell, and the albedo depends on it.
    one_or_two = pays and closest < options.light_angle_rad
    evidence = (
        f"light {more.model.lights} removes {100 * gain:.1f} % of the cost ({100 * options.light_gain:g} % "
        f"asked), changes the albedo by {100 * effect:.2f} % ({100 * options.light_effect:g} % asked), "
        f"{100 * share:.0f} % as strong as the strongest ({100 * options.light_share:g} % asked), "
        f"{math.degrees(closest):.0f} deg from the next, its direction known to "
        f"{math.degrees(spread):.1f} deg ({math.degrees(options.light_direction_rad):.1f} asked)"
    )
    return Verdict(gain, pays and not one_or_two, one_or_two, evidence)


def _smallest_angle(solution: Solution) -> float:
    """Return the smallest angle [rad] between two lights."""
    rows = solution.hypothesis.rows[:, :3]
    cosine = (rows @ rows.T)[np.triu_indices(len(rows), 1)]
    return float(np.arccos(np.clip(cosine.max(), -1, 1)))


def _direction_deviation(problem: ResidualProblem, solution: Solution) -> float:
    """Return the standard deviation [rad] of the weakest light's direction."""
    k = 3 * int(np.argmin(solution.hypothesis.rows[:, 4]))
    variance = np.diag(problem.covariance(solution.model, solution.x))[k : k + 2]
    return math.sqrt(max(float(variance.mean()), 0.0))
