"""What is known of light before a picture is seen: a normal distribution of each parameter."""

import math
from dataclasses import dataclass

import numpy as np

from scan2albedo.albedo.light_parameters import EXPONENT, GLOSS, PARTS, LightModel
from scan2albedo.albedo.node_field import TINY
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import FloatArray

OTHER_EXPONENT = EXPONENT._replace(mean=math.log(16.0), deviation=1.0)
"""Log exponent of what is not skin."""
LIKENESS = 1.0, 0.4
"""How much of the faces' mean pattern a face has."""


@dataclass(frozen=True)
class PriorOfLight:
    """Minus the log of the prior at x, its `slope` (P,) and `curvature` (P,), each parameter's distribution.

    `deviation` (P,) is infinite where nothing is known.
    """

    cost: float
    slope: FloatArray
    curvature: FloatArray
    mean: FloatArray
    deviation: FloatArray


def light_prior(
    model: LightModel, x: FloatArray, log_level: float, level_sd: float, skin: bool, soft: float
) -> PriorOfLight:
    """Return the prior at x = [light, scale, likeness].

    `log_level` is the log albedo that the colour of skin speaks for, known to `level_sd`; the scale is the
    log of the albedo in the unit of V, `soft` the scale of the harmonics.
    """
    mean = np.concatenate([model.table["mean"], [0.0, LIKENESS[0]]])
    deviation = np.concatenate([model.table["deviation"], [math.inf, LIKENESS[1]]])
    scale = math.exp(x[-2])
    if model.has("specular"):
        gloss = model.slices["specular"].start
        if skin:
            mean[gloss] = GLOSS.mean * scale / math.exp(log_level)
            deviation[gloss] = mean[gloss] * math.hypot(level_sd, GLOSS.deviation)
        else:
            mean[gloss] = 0.0
            deviation[gloss] = GLOSS.mean * scale / 0.3
            mean[gloss + 1] = OTHER_EXPONENT.mean
            deviation[gloss + 1] = OTHER_EXPONENT.deviation
    if model.has("bounce"):
        mean[model.slices["bounce"]] = math.exp(log_level)
    if model.has("environment"):
        deviation[model.slices["environment"]] *= soft
    away = (x - mean) / deviation
    known = np.isfinite(deviation)
    cost = float(away @ away) / 2 + float(np.log(deviation[known] * math.sqrt(2 * math.pi)).sum())
    # Lamps shine from any direction, in any order, and each more is half as probable.
    cost += model.lights * math.log(8 * math.pi) - math.lgamma(model.lights + 1)
    slope = away / deviation
    curvature = TINY + 1 / deviation**2
    if model.has("specular"):
        # The highlight's mean and deviation grow with the scale of the albedo.
        by_scale = -x[gloss] / deviation[gloss]
        slope[-2] += away[gloss] * by_scale + 1
        curvature[-2] += by_scale**2
    return PriorOfLight(cost, slope, curvature, mean, deviation)


def parts_steps(
    model: LightModel, x: FloatArray, covariance: FloatArray, prior: PriorOfLight, options: EstimateOptions
) -> list[PlanStep]:
    """Return the plan's rows of the optional parts: the log odds for each against a light without it.

    They are the ratio of prior and posterior where the part is nothing, both normal [1]_; `covariance` (P, P)
    is that of x.

    .. [1] J. Dickey, "The weighted likelihood ratio, linear hypotheses on normal location parameters", Annals
       of Mathematical Statistics 42, 1971.
    """
    steps = list[PlanStep]()
    for name, part in PARTS.items():
        if not model.has(name):
            left_out = options.choice(part.stage) is False
            why = "left out by the caller" if left_out else "nothing that it could change"
            steps.append(PlanStep(part.stage, False, why, "" if left_out else "not judged"))
            continue
        at = np.arange(model.size)[model.slices[name]]
        at = at[np.isfinite(model.table["plain"][at])]
        plain, deviation = model.table["plain"][at], prior.deviation[at]
        away = x[at] - plain
        before = -0.5 * float((((plain - prior.mean[at]) / deviation) ** 2).sum()) - np.log(deviation).sum()
        own = covariance[np.ix_(at, at)] + np.diag(1e-9 * deviation**2)
        after = -(float(away @ np.linalg.solve(own, away)) + float(np.linalg.slogdet(own)[1])) / 2
        evidence = f"log odds {before - after:.1f}"
        steps.append(PlanStep(part.stage, True, "in the model, as its prior allows", evidence))
    return steps
