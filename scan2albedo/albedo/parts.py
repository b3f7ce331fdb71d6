"""Which optional parts of the light's model a scene needs: those that are significant and matter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.problem import Solution, cost_removed
from scan2albedo.albedo.residual_problem import ResidualProblem
from scan2albedo.core.plan import PlanStep

FloatArray = NDArray[np.float64]
Descent = Callable[[ResidualProblem, LightModel, FloatArray], Solution]

_BLACK = 1e-3
"""Parts of the median below which a cell's share of a highlight is not told."""
STAGES = {
    "rough": ("albedo.roughness", "surface roughness"),
    "near": ("albedo.near_light", "a finite distance of the light"),
    "specular": ("albedo.specular", "a highlight"),
}
"""Stage and name of the optional parts, in the order in which they are freed."""


@dataclass(frozen=True)
class Need:
    """What a part of the model does.

    `effect` is the root mean square change of the albedo without it, as a part; `deviations` its parameter in
    standard deviations from nothing; `gain` the part of the cost that it removes.
    """

    effect: float
    deviations: float
    gain: float


@dataclass(frozen=True)
class PartsDecided:
    """The solution with the parts it needs, whether it has a highlight, and the plan's rows."""

    solution: Solution
    keeps_highlight: bool
    steps: list[PlanStep]


def allowed_parts(brdf: str, options: EstimateOptions) -> list[str]:
    """Return the parts that neither caller nor reflectance leaves out, in the order to free them."""
    asked = _asked(options)
    return [
        part for part in STAGES if asked[part] is not False and not (part == "rough" and brdf == "lambert")
    ]


def decide_parts(
    problem: ResidualProblem, full: Solution, options: EstimateOptions, descend: Descent
) -> PartsDecided:
    """Divide out what colour tells, then leave out the parts that the scene does not need.

    Parameters
    ----------
    problem : ResidualProblem
        Without guide.
    full : Solution
        An optimum of it with every allowed part free.
    options : EstimateOptions
    descend : callable
        Returns the optimum of a problem near x.
    """
    asked, rows = _asked(options), list[PlanStep]()
    current, chosen, glossy = _decide_highlight(problem, full, options, descend, rows)
    for part in ("near", "rough"):
        if not getattr(current.model, part) or chosen.meter.exhausted:
            continue
        if asked[part]:
            rows.append(PlanStep(STAGES[part][0], True, "asked for"))
            continue
        without = _without(chosen, current, part, descend)
        if not np.isfinite(without.cost):
            break
        need = _need(chosen, current, without, part)
        least = options.distance_effect if part == "near" else options.roughness_effect
        deviations = options.distance_deviations if part == "near" else options.roughness_deviations
        gain = options.distance_gain if part == "near" else options.roughness_gain
        enters = need.effect >= least and (need.deviations >= deviations or need.gain >= gain)
        rows.append(_row(part, enters, need, least, deviations, gain))
        if not enters:
            current = without
    judged = {row.stage for row in rows}
    rows += [row for row in undecided(current.model, options) if row.stage not in judged]
    return PartsDecided(current, glossy, rows)


def undecided(model: LightModel, options: EstimateOptions) -> list[PlanStep]:
    """Return the plan's rows of the parts that nobody judged: the caller, or the end of a budget, decides."""
    rows = []
    for part, choice in _asked(options).items():
        stage = STAGES[part][0]
        if choice is False:
            rows.append(PlanStep(stage, False, "left out by the caller"))
        elif not (part == "rough" and model.brdf == "lambert"):
            reason = "asked for" if choice else "the budget ended before it was judged"
            rows.append(PlanStep(stage, getattr(model, part), reason, "not judged"))
    return rows


def _asked(options: EstimateOptions) -> dict[str, bool | None]:
    return {"rough": options.roughness, "near": options.near_light, "specular": options.specular}


def _decide_highlight(
    problem: ResidualProblem,
    full: Solution,
    options: EstimateOptions,
    descend: Descent,
    rows: list[PlanStep],
) -> tuple[Solution, ResidualProblem, bool]:
    """Return the optimum with or without highlight, the guided problem it belongs to, and which it is.

    A highlight whitens what it covers, and so does a lighter pigment: each of the two hypotheses gets the
    guide that follows from it.
    """
    plain_problem = problem.guided(None)
    if problem.meter.exhausted:
        return full, problem, False
    if not full.model.specular:
        return descend(plain_problem, full.model, full.x), plain_problem, False
    highlight = problem.highlight(full.model, full.x)
    deviations = _deviations(problem, full, "specular")
    glossy_problem = problem.guided(highlight)
    glossy = descend(glossy_problem, full.model, full.x)
    stage, what = STAGES["specular"]
    if options.specular:
        rows.append(PlanStep(stage, True, "asked for"))
        return glossy, glossy_problem, True
    model = full.model.without_part("specular")
    plain = descend(plain_problem, model, full.model.extend(full.x, model))
    if not (np.isfinite(glossy.cost) and np.isfinite(plain.cost)):
        return full, problem, False
    gain = cost_removed(glossy.cost, plain.cost)
    found = glossy_problem.highlight(glossy.model, glossy.x)
    share = np.minimum(found / np.maximum(problem.level.value, _BLACK), 1.0)
    effect = float(np.sqrt(np.mean(share**2)))
    # A white highlight leaves something of every channel.
    beyond = float(np.mean(found > problem.level.color.min(1)))
    enters = (
        effect >= options.specular_effect
        and beyond <= options.specular_beyond
        and (
            gain >= options.specular_gain
            or (deviations >= options.specular_deviations and gain > 0)
            or (deviations >= options.specular_likely and gain >= options.specular_likely_gain)
            or (deviations >= options.specular_certain and gain >= -options.specular_loss)
        )
    )
    evidence = (
        f"{100 * effect:.2f} % of the image ({100 * options.specular_effect:g} % asked), {deviations:.0f} "
        f"standard deviations ({options.specular_deviations:g} asked, {options.specular_likely:g} beside "
        f"{100 * options.specular_likely_gain:g} % of the cost), removes {100 * gain:.1f} % of the "
        f"cost, brighter than a channel on {100 * beyond:.1f} % of the cells"
    )
    rows.append(PlanStep(stage, enters, f"{what} matters" if enters else f"{what} does not matter", evidence))
    return (glossy, glossy_problem, True) if enters else (plain, plain_problem, False)


def _without(problem: ResidualProblem, full: Solution, part: str, descend: Descent) -> Solution:
    model = full.model.without_part(part)
    return descend(problem, model, full.model.extend(full.x, model))


def _need(problem: ResidualProblem, full: Solution, without: Solution, part: str) -> Need:
    change, gain = albedo_change(problem, full, without), cost_removed(full.cost, without.cost)
    return Need(change, _deviations(problem, full, part), gain)


def albedo_change(problem: ResidualProblem, first: Solution, second: Solution) -> float:
    """Return by which part, root mean square, the albedos of two solutions differ, best scale removed."""
    ratio = problem.light(first.model, first.x) / problem.light(second.model, second.x)
    return float(np.std(ratio) / np.mean(ratio))


def _deviations(problem: ResidualProblem, solution: Solution, part: str) -> float:
    """Return how many standard deviations the part's parameter is away from its plain value."""
    k = solution.model.position_of(part)
    plain = 1.0 if part == "rough" and solution.model.brdf == "minnaert" else 0.0
    variance = float(problem.covariance(solution.model, solution.x)[k, k])
    away = abs(float(solution.x[k]) - plain)
    return away / max(np.sqrt(max(variance, 0.0)), 1e-9)


def _row(part: str, enters: bool, need: Need, least: float, deviations: float, gain: float) -> PlanStep:
    stage, what = STAGES[part]
    return PlanStep(
        stage,
        enters,
        f"{what} matters" if enters else f"{what} does not matter",
        f"changes the albedo by {100 * need.effect:.2f} % ({100 * least:g} % asked), "
        f"{need.deviations:.0f} standard deviations from none ({deviations:g} asked), "
        f"removes {100 * need.gain:.1f} % of the cost ({100 * gain:g} %)",
    )
