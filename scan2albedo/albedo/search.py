"""The global search over light directions, and its local and annealed refinement."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.problem import Problem, Solution
from scan2albedo.lighting.shadow_map import VisibilityTable
from scan2albedo.optimization import AnnealingOptions, simulated_annealing

FloatArray = NDArray[np.float64]

_PAIR_DIRECTIONS = 40
_AGREEMENT_RAD = 0.05
_AGREEMENT_COST = 0.02


def direction_grid(
    problem: Problem, model: LightModel, table: VisibilityTable, options: EstimateOptions
) -> list[Solution]:
    """Return starts for `model`: the best of all directions (or pairs of them) and strengths, kept apart.

    For more than two lights the pairs' best is extended greedily by `add_light`.
    """
    lights = min(model.lights, 2)
    few = (
        table.directions
        if lights == 1
        else table.directions[:: -(-len(table.directions) // _PAIR_DIRECTIONS)]
    )
    strengths = options.grid_strengths if lights == 1 else options.grid_strengths[:2]
    found: list[tuple[float, FloatArray, tuple[int, ...]]] = []
    for chosen in combinations(range(len(few)), lights):
        visible = np.stack([table.nearest(few[k]) for k in chosen])
        for energies in product(strengths, repeat=lights):
            if problem.meter.exhausted and found:
                break
            x = model.from_lights(
                np.resize(few[list(chosen)], (model.lights, 3)), np.resize(energies, model.lights)
            )
            hypothesis = model.decode(x)
            padded = np.resize(visible, (model.lights, visible.shape[1]))
            found.append((problem.cost(hypothesis, padded), x, chosen))
    found.sort(key=lambda item: item[0])
    problem.meter.record(found[0][0])
    return [
        Solution(model, x, cost)
        for cost, x, _ in _distinct(found, few, options.starts * lights, options.start_separation_rad)
    ]


def _distinct(
    found: list[tuple[float, FloatArray, tuple[int, ...]]],
    directions: FloatArray,
    count: int,
    separation_rad: float,
) -> list[tuple[float, FloatArray, tuple[int, ...]]]:
    """Return the `count` cheapest whose directions differ pairwise by more than `separation_rad`."""
    kept: list[tuple[float, FloatArray, tuple[int, ...]]] = []
    cosine = np.cos(separation_rad)
    for item in found:
        close = [
            max(
                all(directions[a] @ directions[b] > cosine for a, b in zip(item[2], order, strict=True))
                for order in (other[2], other[2][::-1])
            )
            for other in kept
        ]
        if not any(close):
            kept.append(item)
        if len(kept) == count:
            break
    return kept


def polish(problem: Problem, start: Solution, evaluations: int) -> Solution:
    """Improve a solution by Nelder-Mead with shadow rays, within the meter's budget.

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

    def stop_when_exhausted(intermediate_result: object) -> None:
        if problem.meter.exhausted:
            raise StopIteration

    result = minimize(
        lambda point: problem.cost(model.decode(point)),
        x,
        method="Nelder-Mead",
        bounds=list(zip(lower, upper, strict=True)),
        callback=stop_when_exhausted,
        options={
            "initial_simplex": np.clip(simplex, lower, upper),
            "maxfev": left,
            "xatol": 1e-4,
            "fatol": 1e-7,
            "adaptive": model.size > 6,
        },
    )
    problem.meter.record(float(result.fun))
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

    def objective(x: FloatArray) -> float:
        hypothesis = model.decode(x)
        return problem.cost(hypothesis, np.stack([table.nearest(row[:3]) for row in hypothesis.rows]))

    result = simulated_annealing(
        objective,
        start.x,
        lower,
        upper,
        seed=seed,
        initial_step=4 * model.steps(),
        options=AnnealingOptions(evaluations=left),
        meter=problem.meter,
    )
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
