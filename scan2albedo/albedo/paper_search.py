"""The search of Toderici et al., section 3.2: the deviation of the albedo from its block means, annealed."""

from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.light_parameters import PARTS, LightModel, Solution
from scan2albedo.albedo.node_field import TINY
from scan2albedo.albedo.shaded_image import CONE_RAD, LightFound, ShadedImage
from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import FloatArray, NDArray
from scan2albedo.lighting.shading import shade_rows
from scan2albedo.lighting.shadow_map import ShadowMap, VisibilityTable, cone_directions
from scan2albedo.optimization.annealing import simulated_annealing

_DIRECTIONS = 80
"""Directions of the table of visibilities: annealing moves too far for shadow rays of its own."""
_ANNEALING = 1500
"""Evaluations of the annealing for each light."""
_POLISH = 160
"""Evaluations of each descent after it."""
_LIGHT_GAIN = 0.04
"""Part of the cost that one more light has to remove."""
_LIGHT_SHARE = 0.1
"""Intensity of one more light beside the strongest one's."""


def albedo_deviation(
    value: FloatArray,
    weight: FloatArray,
    light: FloatArray,
    specular: FloatArray,
    blocks: NDArray,
    block_count: int,
) -> float:
    """Return sum w |A - mean_b A| / sum w A with A = (T - I_s) / I: the paper's objective, normalised.

    Without the division it falls as the lights grow stronger. `blocks` (S, N) are S partitions.
    """
    albedo = np.maximum(value - specular, 0.0) / light
    total = float(weight @ albedo)
    if total <= 0:
        return np.inf
    deviation = 0.0
    for block in blocks:
        mass = np.maximum(np.bincount(block, weight, block_count), TINY)
        mean = np.bincount(block, weight * albedo, block_count) / mass
        deviation += float(weight @ np.abs(albedo - mean[block]))
    return deviation / (len(blocks) * total)


class DeviationProblem:
    """The objective over the cells of one level."""

    def __init__(self, scene: ShadedImage, level: Level) -> None:
        self._level, self._view, self.meter = level, np.asarray(scene.view), scene.meter
        self._blocks, self._count = level.blocks()
        self._shadows = ShadowMap(scene.shadows[0], level.anchor, level.normal)

    @cached_property
    def _table(self) -> VisibilityTable:
        return self._shadows.table(cone_directions(_DIRECTIONS, self._view, CONE_RAD))

    def cost(self, model: LightModel, x: FloatArray, *, rays: bool) -> float:
        """Return the objective at x, with shadow rays or with those of the nearest tabulated direction."""
        found, level = model.decode(x), self._level
        far = [1 / near if near > 0 else np.inf for near in found.rows[:, 3]]
        toward = found.rows[:, :3]
        seen = map(self._shadows.visible, toward, far) if rays else map(self._table.nearest, toward)
        where = level.position, level.normal, np.array(list(seen))
        shading = shade_rows(*where, found.rows, self._view, found.reflectance, level.scale)
        known = level.value, level.weight, shading.light, shading.specular, self._blocks, self._count
        return albedo_deviation(*known)


def paper_search(scene: ShadedImage, lights: int | None, seed: int) -> LightFound:
    """Anneal the paper's objective, all parts of the model free; `lights` None adds lights while they pay."""
    meter, options = scene.meter, scene.options
    middle, largest = (DeviationProblem(scene, scene.at(size).level) for size in options.sizes[1:])
    model = scene.model(1, ("near", "rough", "specular"))
    best = _annealed(middle, model, model.from_lights(scene.directions[:1], np.ones(1)), seed)
    meter.record(largest.cost(best.model, best.x, rays=True))
    reason, evidence = "one light", "no second one tried"
    for count in range(2, (options.maximal_lights if lights is None else lights) + 1):
        if meter.exhausted:
            break
        more = replace(model, lights=count)
        trial = _annealed(middle, more, np.insert(best.x, 3 * (count - 1), [0.0, 0.0, np.log(0.5)]), seed)
        gain = 1 - trial.cost / best.cost if best.cost > 0 else 0.0
        intensity = trial.hypothesis.rows[:, 4]
        accepted = gain >= _LIGHT_GAIN and intensity.min() >= _LIGHT_SHARE * intensity.max()
        reason = f"{count} lights" if accepted else f"{count - 1} light(s): one more does not pay"
        evidence = f"light {count} removes {100 * gain:.1f} % of the cost ({100 * _LIGHT_GAIN:g} % asked)"
        if not accepted and lights is None:
            break
        best = trial
        meter.record(largest.cost(best.model, best.x, rays=True))
    best = _polished(largest, best, 2 * _POLISH)
    asked = reason if lights is None else f"{lights} asked for"
    steps = [scene.shadows[1], PlanStep("albedo.lights", True, asked, evidence)]
    for name, part in PARTS.items():
        why = "left out by the caller" if options.choice(part.stage) is False else "part of the paper's model"
        steps.append(PlanStep(part.stage, model.has(name), why))
    meter.record(best.cost)
    return LightFound(best, steps)


def _annealed(problem: DeviationProblem, model: LightModel, x: FloatArray, seed: int) -> Solution:
    meter = problem.meter.untraced()
    found = simulated_annealing(
        lambda x: problem.cost(model, x, rays=False),
        x,
        *model.bounds,
        seed=seed,
        initial_step=4 * model.table["step"],
        evaluations=_ANNEALING * model.lights,
        meter=meter,
    )
    problem.meter.count(meter.evaluations)
    return _polished(problem, Solution(model, found.x, found.cost), _POLISH * model.lights)


def _polished(problem: DeviationProblem, start: Solution, evaluations: int) -> Solution:
    """Go down by Nelder and Mead's simplex with shadow rays, as long as the budget lasts."""
    model, meter = start.model, problem.meter
    left = min(evaluations, (meter.budget.evaluations or evaluations + meter.evaluations) - meter.evaluations)
    if meter.exhausted or left <= model.size + 1:
        return start
    bounds, step = np.stack(model.bounds, 1), model.table["step"]
    simplex = np.vstack([start.x, start.x + np.diag(np.where(start.x + step > bounds[:, 1], -step, step))])

    def cost(x: FloatArray) -> float:
        meter.count()
        return np.inf if meter.out_of_time else problem.cost(model, x, rays=True)

    limits = {"initial_simplex": simplex, "maxfev": left, "xatol": 1e-4, "fatol": 1e-7}
    found = minimize(cost, start.x, method="Nelder-Mead", bounds=bounds, options=limits)
    return Solution(model, np.asarray(found.x, float), float(found.fun))
