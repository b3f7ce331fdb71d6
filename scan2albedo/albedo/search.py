"""The global search over light directions, and its local and annealed refinement."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, minimize

from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.problem import Problem, Solution
from scan2albedo.lighting.shadow_map import VisibilityTable
from scan2albedo.optimization import AnnealingOptions, simulated_annealing

FloatArray = NDArray[np.float64]

_PAIR_DIRECTIONS = 40
_AGREEMENT_RAD = 0.05
_AGREEMENT_COST = 0.02


_Found = tuple[float, FloatArray, tuple[int, ...]]
"""Cost, x, and the indices of the tabulated directions of a start."""


def direction_grid(
    problem: Problem, model: LightModel, table: VisibilityTable, options: EstimateOptions
) -> list[Solution]:
    """Return starts for `model`: the cheapest of all directions and strengths, kept apart.

    One light: every tabulated direction. Two: all pairs of a coarser choice of them, since the best single
    direction lies between two lights. More: the best pairs, one light after another added.
    """
    count = len(table.directions)
    step = 1 if model.lights == 1 else -(-count // _PAIR_DIRECTIONS)
    choice = tuple(range(0, count, step))
    first = min(model.lights, 2)
    found = _evaluate(problem, model, table, combinations(choice, first), options)
    for _ in range(first, model.lights):
        kept = _distinct(found, table.directions, 2, options.start_separation_rad)
        more = ((*item[2], k) for item in kept for k in choice if k not in item[2])
        found = _evaluate(problem, model, table, more, options)
    return [
        Solution(model, x, cost)
        for cost, x, _ in _distinct(
            found, table.directions, options.starts * first, options.start_separation_rad
        )
    ]


def _evaluate(
    problem: Problem,
    model: LightModel,
    table: VisibilityTable,
    choices: Iterable[tuple[int, ...]],
    options: EstimateOptions,
) -> list[_Found]:
    """Return the costs of each choice of directions with each strength, cheapest first."""
    found: list[_Found] = []
    for chosen in choices:
        if problem.meter.exhausted and found:
            break
        lights = len(chosen)
        part = replace(model, lights=lights)
        strengths = options.grid_strengths if lights == 1 else options.grid_strengths[:2]
        for energies in product(strengths, repeat=min(lights, 2)):
            x = part.from_lights(table.directions[list(chosen)], np.resize(energies, lights))
            cost = problem.cost(part.decode(x), table.visibility[list(chosen)])
            found.append((cost, x, chosen))
    return sorted(found, key=lambda item: item[0])


def _distinct(found: list[_Found], directions: FloatArray, count: int, separation_rad: float) -> list[_Found]:
    """Return the `count` cheapest whose lights differ pairwise by more than `separation_rad`."""
    kept: list[_Found] = []
    cosine = np.cos(separation_rad)
    for item in found:
        similar = [
            (directions[list(item[2])] @ directions[list(other[2])].T > cosine).any(1).all() for other in kept
        ]
        if not any(similar):
            kept.append(item)
        if len(kept) == count:
            break
    return kept


def polish(problem: Problem, start: Solution, evaluations: int, *, traced: bool = False) -> Solution:
    """Improve a solution by Nelder-Mead with shadow rays, within the meter's budget.

    `traced` records improvements of more than a thousandth: at the finest size only, see `Yardstick`.

    References
    ----------
    .. [1] J. A. Nelder, R. Mead, "A simplex method for function minimization", Computer Journal 7, 1965.
    """
    left = _remaining(problem, evaluations)
    model = start.model
    if left <= model.size + 1:
        return start
    lower, upper = model.bounds
    x = np.clip(start.x, lower, upper)
    step = model.steps()
    step = np.where(x + step > upper, -step, step)
    simplex = np.vstack([x, x + np.diag(step)])

    meter = problem.meter

    def after_each(intermediate_result: OptimizeResult) -> None:
        cost = float(intermediate_result.fun)
        if traced and cost < 0.999 * meter.rows[-1].error:
            meter.record(cost)
        if meter.exhausted:
            raise StopIteration

    result = minimize(
        lambda point: problem.cost(model.decode(point)),
        x,
        method="Nelder-Mead",
        bounds=list(zip(lower, upper, strict=True)),
        callback=after_each,
        options={
            "initial_simplex": np.clip(simplex, lower, upper),
            "maxfev": left,
            "xatol": 1e-4,
            "fatol": 1e-7,
            "adaptive": model.size > 6,
        },
    )
    return Solution(model, np.asarray(result.x, float), float(result.fun))


def anneal(
    problem: Problem, start: Solution, table: VisibilityTable, seed: int, options: EstimateOptions
) -> Solution:
    """Search globally by simulated annealing with tabulated shadows, from `start`."""
    model = start.model
    left = _remaining(problem, options.annealing_evaluations)
    if left < 2:
        return start
    lower, upper = model.bounds

    meter = problem.meter.sub_meter("light_annealing", problem.meter.unit)

    def objective(x: FloatArray) -> float:
        hypothesis = model.decode(x)
        visible = np.stack([table.nearest(row[:3]) for row in hypothesis.rows])
        return problem.evaluate(hypothesis, visible)

    result = simulated_annealing(
        objective,
        start.x,
        lower,
        upper,
        seed=seed,
        initial_step=4 * model.steps(),
        options=AnnealingOptions(evaluations=left),
        meter=meter,
    )
    problem.meter.merge(meter)
    return Solution(model, result.x, result.cost)


def disagree(solutions: list[Solution]) -> bool:
    """Return whether the polished starts ended in different places at nearly the same cost.

    One start alone, or the same place reached from several, is agreement.
    """
    ordered = sorted(solutions, key=lambda s: s.cost)
    best = ordered[0].hypothesis.rows
    for other in ordered[1:]:
        rows = other.hypothesis.rows
        apart = np.arccos(np.clip(np.abs(best[:, :3] @ rows[:, :3].T).max(1), -1, 1)).max()
        if other.cost < ordered[0].cost * (1 + _AGREEMENT_COST) and apart > _AGREEMENT_RAD:
            return True
    return False


def _remaining(problem: Problem, wanted: int) -> int:
    """Return how many of `wanted` evaluations the budget leaves."""
    meter = problem.meter
    if meter.exhausted:
        return 0
    limit = meter.budget.evaluations
    return wanted if limit is None else min(wanted, limit - meter.evaluations)
