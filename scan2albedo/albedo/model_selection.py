"""Model selection: how many lights and which optional parts of the model the image gives evidence of."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scan2albedo.albedo.light_parameters import LightModel, Solution, cost_removed
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.residual_objective import ResidualProblem, descend
from scan2albedo.albedo.tint import Tint, tint_on
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.plan import PlanStep

LIGHT_GAIN, ENVIRONMENT_GAIN = 0.025, 0.05
"""Parts of the cost that one more light, and an environment, have to remove."""
ENVIRONMENT_FLOOR = 0.01
"""Cost that is added to either side before the second: of nearly nothing a part says little."""
_LIGHT_EFFECT = 0.02
"""Root mean square change of the albedo that it has to make."""
_CERTAIN_GAIN, _CERTAIN_EFFECT = 0.15, 0.01
"""With so much of the cost removed a smaller change serves."""
_LIGHT_SHARE = 0.1
"""Intensity that every light has to have, as a part of the strongest one's."""
_LEAST_INTENSITY = 0.15
"""Intensity that it has to have, as a part of the ambient light's."""
_NEAREST = 0.35
"""Largest part that the surface's radius may be of a lamp's distance: lamps of a head are farther than some
0.3 m, and nearer ones fit hair and beard."""
_LIGHT_ANGLE_RAD = 0.26
"""Angle between two lights below which they may be one broad light: an image fits both."""
_LIGHT_DIRECTION_RAD, _LIGHT_INTENSITY = 0.12, 0.7
"""Standard deviations that its direction and the logarithm of its intensity may have: only a lamp's are so
definite."""
_LIT_COSINE, _LIT_SHARE = 0.2, 0.25
"""Cosine of the light above which a cell counts as lit by a lamp, and the part of the cells that has to be: a
lamp behind or below the head, which reaches a rim alone, stands for light from the surroundings."""

_SPECULAR_EFFECT = 0.004
"""Root mean square share of the image that a highlight has to have."""
_SPECULAR_BEYOND = 0.02
"""Part of the cells on which it may exceed the darkest channel: white leaves something of each."""
_SPECULAR_GAIN, _SPECULAR_DEVIATIONS = 0.05, 4.0
"""Part of the cost that it removes, or standard deviations of its strength from 0: one serves."""
_LEAST_DEVIATIONS = 1.0
"""Required beside the gain: uniform haze on a plane lowers the cost too, but its strength is undetermined."""
_LIKELY_GAIN, _LIKELY_DEVIATIONS = 0.02, 2.4
"""The same, where both serve together."""
_CERTAIN_LOSS, _CERTAIN_DEVIATIONS = 0.03, 12.0
"""So sure, it may even add to the cost: it takes colour away from the texture's guide."""

_BRIGHTEST, _GLARING = 99.8, 4.0
"""Percentile of the albedo, and how many times the median it has to be, to be reported."""
_NEAR = 1e-3
"""Part of a parameter's range that counts as its end."""
_BLACK = 1e-3
"""Parts of the median below which a cell's share of a highlight means nothing."""


@dataclass(frozen=True)
class Part:
    """An optional part of the light's model: stage and name for the plan, and what it has to bring.

    `effect` is the least root mean square change of the albedo; beside it, either `deviations`, standard
    deviations of its parameter from nothing, or `gain`, the part of the cost that it removes, is required.
    """

    stage: str
    name: str
    effect: float = 0.0
    deviations: float = 0.0
    gain: float = 0.0


PARTS = {
    "rough": Part("albedo.roughness", "surface roughness", 0.008, 3.0, 0.04),
    "near": Part("albedo.near_light", "a finite distance of the light", 0.014, 8.0, 0.04),
    "specular": Part("albedo.specular", "a highlight"),
    "occlusion": Part("albedo.occlusion", "occlusion of ambient light", 0.008, 3.0, 0.02),
    "bounce": Part("albedo.bounce", "light bounced off the surface", 0.006, 3.0, 0.01),
    "environment": Part("albedo.environment", "a large environment", 0.01, math.inf, ENVIRONMENT_GAIN),
}
"""By the name of their field of `LightModel`, in the order in which they are freed."""


@dataclass(frozen=True)
class LightEvidence:
    """What one more light brings: the part of the cost that it removes, and whether that is worth it.

    It may be `one_or_two`, worth it but so close to another light that both may be one broad light.
    """

    gain: float
    accepted: bool
    one_or_two: bool
    evidence: str


@dataclass(frozen=True)
class PartsDecided:
    """The solution with the parts it needs, whether it has a highlight, and the plan's rows."""

    solution: Solution
    highlight: bool
    steps: list[PlanStep]


def light_evidence(problem: ResidualProblem, more: Solution, fewer: Solution) -> LightEvidence:
    """Compare a solution with one more light to one with fewer, both optima of `problem`.

    The light is accepted when it removes enough of the cost, changes the albedo, is not far weaker than the
    strongest, and its direction is known.
    """
    gain = cost_removed(more.cost, fewer.cost)
    rows = more.hypothesis.rows
    intensities, toward = rows[:, 4], rows[:, :3]
    share = float(intensities.min() / intensities.max())
    effect = albedo_change(problem, more, fewer)
    # The part of the cells that the lamp lights which lights the fewest.
    lamps = problem.at(more.model, more.x).lamps / rows[:, 4:]
    lit = float(np.average(lamps > _LIT_COSINE, axis=1, weights=problem.level.weight).min())
    closest = math.pi
    if len(rows) > 1:
        cosine = (toward @ toward.T)[np.triu_indices(len(rows), 1)]
        closest = float(np.arccos(np.clip(cosine.max(), -1, 1)))
    # Standard deviations of the weakest lamp's direction and log intensity.
    k = 3 * int(np.argmin(intensities))
    variance = np.maximum(np.diag(covariance(problem, more)), 0.0)
    spread, unsure = math.sqrt(float(variance[k : k + 2].mean())), math.sqrt(float(variance[k + 2]))
    nearness = more.model.radius_mm * float(rows[:, 3].max())
    worth_it = (
        gain >= LIGHT_GAIN
        and share >= _LIGHT_SHARE
        and intensities.min() >= _LEAST_INTENSITY
        and effect >= (_CERTAIN_EFFECT if gain >= _CERTAIN_GAIN else _LIGHT_EFFECT)
        and lit >= _LIT_SHARE
        and spread <= _LIGHT_DIRECTION_RAD
        and unsure <= _LIGHT_INTENSITY
        and nearness <= _NEAREST
    )
    one_or_two = worth_it and closest < _LIGHT_ANGLE_RAD
    evidence = (
        f"light {more.model.lights} removes {100 * gain:.1f} % of the cost ({100 * LIGHT_GAIN:g} % "
        f"asked), changes the albedo by {100 * effect:.2f} % ({100 * _LIGHT_EFFECT:g} % asked), "
        f"{100 * share:.0f} % as strong as the strongest ({100 * _LIGHT_SHARE:g} % asked), "
        f"{intensities.min():.2g} times the ambient light ({_LEAST_INTENSITY:g} asked), lights "
        f"{100 * lit:.0f} % of the surface ({100 * _LIT_SHARE:g} % asked), its strength known to "
        f"{100 * unsure:.0f} % ({100 * _LIGHT_INTENSITY:g} % asked), "
        f"{math.degrees(closest):.0f} deg from the next, its direction known to "
        f"{math.degrees(spread):.1f} deg ({math.degrees(_LIGHT_DIRECTION_RAD):.1f} asked), the surface's "
        f"radius {100 * nearness:.0f} % of its distance (at most {100 * _NEAREST:g} %)"
    )
    return LightEvidence(gain, worth_it and not one_or_two, one_or_two, evidence)


def environment_gain(more: Solution, fewer: Solution) -> float:
    """Return the part of the cost that an environment removes; see `ENVIRONMENT_FLOOR`."""
    return cost_removed(more.cost + ENVIRONMENT_FLOOR, fewer.cost + ENVIRONMENT_FLOOR)


def covariance(problem: ResidualProblem, solution: Solution) -> FloatArray:
    """Return (P, P) the covariance of an optimum's parameters; see `Residual.covariance`."""
    return problem.at(solution.model, solution.x, outlines=False).covariance()


def albedo_change(problem: ResidualProblem, first: Solution, second: Solution) -> float:
    """Return by which part, root mean square, the albedos of two solutions differ, best scale removed."""
    one, other = (problem.at(s.model, s.x).light for s in (first, second))
    ratio = one / other
    return float(np.std(ratio) / np.mean(ratio))


def allowed_parts(brdf: str, options: EstimateOptions) -> list[str]:
    """Return the parts that neither caller nor reflectance leaves out, in the order to free them."""
    return [
        name
        for name, part in PARTS.items()
        if options.choice(part.stage) is not False and not (name == "rough" and brdf == "lambert")
    ]


def decide_parts(
    problem: ResidualProblem, full: Solution, options: EstimateOptions, tint: Tint | None
) -> PartsDecided:
    """Divide out the texture that colour predicts, then leave out the parts that the scene does not need.

    `full` is an optimum, every allowed part free, of `problem`, which has no guide yet.
    """
    rows = list[PlanStep]()
    current, chosen, highlight = _decide_highlight(problem, full, options, tint_on(problem, tint, full), rows)
    for name in ("environment", "near", "rough", "bounce", "occlusion"):
        part = PARTS[name]
        if not current.model.has(name) or chosen.meter.exhausted:
            continue
        if options.choice(part.stage):
            rows.append(PlanStep(part.stage, True, "asked for"))
            continue
        without = _without(chosen, current, name, options)
        if not np.isfinite(without.cost):
            break
        effect, deviations = albedo_change(chosen, current, without), _deviations(chosen, current, name)
        gain = (
            environment_gain(current, without)
            if name == "environment"
            else cost_removed(current.cost, without.cost)
        )
        enters = effect >= part.effect and (deviations >= part.deviations or gain >= part.gain)
        evidence = (
            f"changes the albedo by {100 * effect:.2f} % ({100 * part.effect:g} % asked), "
            f"{deviations:.0f} standard deviations from none ({part.deviations:g} asked), "
            f"removes {100 * gain:.1f} % of the cost ({100 * part.gain:g} %)"
        )
        rows.append(_row(part, enters, evidence))
        if not enters:
            current = without
    decided = {row.stage for row in rows}
    why = (
        "the budget ended before it was judged" if chosen.meter.exhausted else "nothing that it could change"
    )
    rows += [row for row in undecided(current.model, options, why) if row.stage not in decided]
    return PartsDecided(current, highlight, rows)


def _row(part: Part, enters: bool, evidence: str) -> PlanStep:
    return PlanStep(
        part.stage, enters, f"{part.name} matters" if enters else f"{part.name} does not matter", evidence
    )


def undecided(
    model: LightModel, options: EstimateOptions, why: str = "the budget ended before it was judged"
) -> list[PlanStep]:
    """Return the plan's rows of parts that no evidence decided on; `why` where the caller did not either."""
    rows = []
    for name, part in PARTS.items():
        choice = options.choice(part.stage)
        if choice is False:
            rows.append(PlanStep(part.stage, False, "left out by the caller"))
        elif not (name == "rough" and model.brdf == "lambert"):
            reason = "asked for" if choice else why
            rows.append(PlanStep(part.stage, model.has(name), reason, "not judged"))
    return rows


def _decide_highlight(
    problem: ResidualProblem,
    full: Solution,
    options: EstimateOptions,
    tint: FloatArray | None,
    rows: list[PlanStep],
) -> tuple[Solution, ResidualProblem, bool]:
    """Return the optimum with or without highlight, the guided problem it belongs to, and which it is.

    A highlight whitens what it covers, and so does a lighter pigment: each of the two models gets the guide
    that follows from it.
    """
    plain_problem, part = problem.guided(None, tint), PARTS["specular"]
    if problem.meter.exhausted:
        return full, problem, False
    if not full.model.has("specular"):
        plain = descend(plain_problem, full.model, full.x, options.descent_iterations)
        return plain, plain_problem, False
    deviations = _deviations(problem, full, "specular")
    highlight = problem.at(full.model, full.x).highlight()
    glossy_problem = problem.guided(highlight, tint)
    if (plain_problem.guide.explained > 0) != (glossy_problem.guide.explained > 0):
        # One with and one without a guide do not compare.
        plain_problem = problem.guided(None, tint, min_explained=0.0)
        glossy_problem = problem.guided(highlight, tint, min_explained=0.0)
    glossy = descend(glossy_problem, full.model, full.x, options.descent_iterations)
    if options.choice(part.stage):
        rows.append(PlanStep(part.stage, True, "asked for"))
        return glossy, glossy_problem, True
    plain = _without(plain_problem, full, "specular", options)
    if not (np.isfinite(glossy.cost) and np.isfinite(plain.cost)):
        return full, problem, False
    gain = cost_removed(glossy.cost, plain.cost)
    found = glossy_problem.at(glossy.model, glossy.x).highlight()
    share = np.minimum(found / np.maximum(problem.level.value, _BLACK), 1.0)
    effect = float(np.sqrt(np.mean(share**2)))
    beyond = float(np.mean(found > problem.level.color.min(1)))
    enters = (
        effect >= _SPECULAR_EFFECT
        and beyond <= _SPECULAR_BEYOND
        and (
            (gain >= _SPECULAR_GAIN and deviations >= _LEAST_DEVIATIONS)
            or (deviations >= _SPECULAR_DEVIATIONS and gain > 0)
            or (deviations >= _LIKELY_DEVIATIONS and gain >= _LIKELY_GAIN)
            or (deviations >= _CERTAIN_DEVIATIONS and gain >= -_CERTAIN_LOSS)
        )
    )
    evidence = (
        f"{100 * effect:.2f} % of the image ({100 * _SPECULAR_EFFECT:g} % asked), {deviations:.0f} "
        f"standard deviations ({_SPECULAR_DEVIATIONS:g} asked, {_LIKELY_DEVIATIONS:g} beside "
        f"{100 * _LIKELY_GAIN:g} % of the cost), removes {100 * gain:.1f} % of the "
        f"cost, brighter than a channel on {100 * beyond:.1f} % of the cells"
    )
    rows.append(_row(part, enters, evidence))
    return (glossy, glossy_problem, True) if enters else (plain, plain_problem, False)


def _without(problem: ResidualProblem, full: Solution, part: str, options: EstimateOptions) -> Solution:
    model = full.model.with_part(part, False)
    return descend(problem, model, full.model.extend(full.x, model), options.descent_iterations)


def _deviations(problem: ResidualProblem, solution: Solution, part: str) -> float:
    """Return how many standard deviations the part's parameter is away from its plain value."""
    k = solution.model.position_of(part)
    plain = 1.0 if part == "occlusion" or (part == "rough" and solution.model.brdf == "minnaert") else 0.0
    variance = float(covariance(problem, solution)[k, k])
    away = abs(float(solution.x[k]) - plain)
    return away / max(math.sqrt(max(variance, 0.0)), 1e-9)


def limits_step(solution: Solution, albedo: FloatArray) -> PlanStep:
    """Return the plan's row about parameters of the light that are at an end of their range.

    A better light may lie beyond: an ambient light too weak to be seen, a lamp that touches the skin, no
    light at all. Light that is not part of the model stays in the albedo: the row also says where the
    brightest 0.2 % of `albedo` (N,), its V where it was measured, is many times the median.
    """
    model, x = solution.model, solution.x
    lower, upper = model.bounds
    margin = _NEAR * (upper - lower)
    found = []
    for k in range(model.lights):
        i = 3 * k + 2
        for end, reached, bound in (
            ("least", x[i] <= lower[i] + margin[i], lower[i]),
            ("greatest", x[i] >= upper[i] - margin[i], upper[i]),
        ):
            if reached:
                found.append(
                    f"light {k + 1} has the {end} intensity, {math.exp(bound):.3g} times the ambient light"
                )
    if model.has("near"):
        i = model.position_of("near")
        if x[i] >= upper[i] * (1 - _NEAR):
            found.append(f"the lights have the least distance, {model.radius_mm / upper[i]:.3g} mm")
    median, brightest = np.percentile(albedo, (50, _BRIGHTEST))
    if brightest > _GLARING * median > 0:
        found.append(
            f"the brightest {100 - _BRIGHTEST:.1f} % of the albedo is {brightest / median:.0f} times its "
            "median: is a lamp too near to be modelled, or white on black?"
        )
    if not found:
        return PlanStep("albedo.limits", False, "the light lies within what is searched", "no limit reached")
    return PlanStep.doubt("albedo.limits", "the light lies at an end of what is searched", "; ".join(found))
