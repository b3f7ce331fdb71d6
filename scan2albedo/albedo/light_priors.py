"""What is known of light before a picture is seen: one named distribution a parameter."""

import math
from dataclasses import dataclass

import numpy as np

from scan2albedo.albedo.light_parameters import HARMONICS, PARTS, LightModel
from scan2albedo.albedo.node_field import TINY
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import FloatArray

Rows = list[tuple[int, float, float]]
"""Place in x, mean and standard deviation of parameters."""

INTENSITY = math.log(1.5), 1.2
"""Log of a lamp's strength beside the ambient light: from a dim fill to a flash in a dark room."""
NEARNESS = 0.0, 0.06
"""The face's radius by the lamp's distance: lamps stand a metre away and more."""
ROUGHNESS = 0.1, 0.1
"""Oren-Nayar's variance of the facets: skin has some .1 [1]_.

.. [1] S. Marschner et al., "Image-based BRDF measurement including human skin", EGWR 1999.
"""
MINNAERT = 1.0, 0.2
GLOSS = 0.057, 0.47
"""Phong's strength on skin of albedo 1: Beckmann's lobe of roughness .35 and index 1.4 (Fresnel .028) seen
along the normal, .028 / (4 .35^2) [2]_; and what its log errs by beside the prior's level of skin, which is
0.52 off for heads whose group is left out, 0.22 for others.

.. [2] T. Weyrich et al., "Analysis of human faces using a measurement-based skin reflectance model", SIGGRAPH
   2006.
"""
EXPONENT = math.log(6.0), 0.4
"""Log exponent of that lobe of skin: mean and standard deviation."""
OTHER_EXPONENT = math.log(16.0), 1.0
"""The same of anything else."""
FILL = 0.3, 0.2
"""Part of the hidden ambient light that comes back from elsewhere."""
BOUNCE = 0.1
"""Standard deviation of the albedo that bounces light, around what the colour of skin says."""
ENVIRONMENT = 0.35, 0.15
"""Standard deviations of the harmonics of orders 1 and 2, beside the constant: natural light falls so [3]_.

.. [3] R. Dror, A. Willsky, E. Adelson, "Statistical characterization of real-world illumination", J. Vision
   4, 2004.
"""
LIKENESS = 1.0, 0.4
"""How much of the faces' mean pattern a face has."""


@dataclass(frozen=True)
class PriorOfLight:
    """Minus the log of the prior at x, and its `slope` (P,) and `curvature` (P,): all are normal."""

    cost: float
    slope: FloatArray
    curvature: FloatArray
    rows: Rows


def distributions(
    model: LightModel, scale: float, log_level: float, level_sd: float, skin: bool, soft: float
) -> Rows:
    """Return place in x, mean, standard deviation of each parameter that has a prior.

    `log_level` is the log albedo that the colour of skin speaks for, known to `level_sd`; `scale` the log of
    the albedo in the unit of V, `soft` the scale of the harmonics.
    """
    rows = [(3 * k + 2, *INTENSITY) for k in range(model.lights)]
    if model.has("near"):
        rows.append((model.position_of("near"), *NEARNESS))
    if model.has("rough"):
        rows.append((model.position_of("rough"), *(MINNAERT if model.brdf == "minnaert" else ROUGHNESS)))
    if model.has("specular"):
        at = model.position_of("specular")
        if skin:
            gloss = GLOSS[0] * math.exp(scale - log_level)
            rows += [(at, gloss, gloss * math.hypot(level_sd, GLOSS[1])), (at + 1, *EXPONENT)]
        else:
            rows += [(at, 0.0, GLOSS[0] * math.exp(scale) / 0.3), (at + 1, *OTHER_EXPONENT)]
    if model.has("occlusion"):
        rows.append((model.position_of("occlusion"), *FILL))
    if model.has("bounce"):
        rows.append((model.position_of("bounce"), math.exp(log_level), BOUNCE))
    if model.has("environment"):
        first = model.position_of("environment")
        rows += [(first + k, 0.0, soft * ENVIRONMENT[0 if k < 3 else 1]) for k in range(HARMONICS)]
    return rows


def parts_steps(
    model: LightModel, x: FloatArray, covariance: FloatArray, rows: Rows, options: EstimateOptions
) -> list[PlanStep]:
    """Return the plan's rows of the optional parts: the log odds for each against a light without it.

    They are the ratio of prior and posterior where the part is nothing, both normal [1]_. `rows` are those of
    `distributions`, `covariance` (P, P) that of x.

    .. [1] J. Dickey, "The weighted likelihood ratio, linear hypotheses on normal location parameters", Annals
       of Mathematical Statistics 42, 1971.
    """
    steps, known = [], {at: (mean, deviation) for at, mean, deviation in rows}
    for name, stage in PARTS.items():
        if not model.has(name):
            left_out = options.choice(stage) is False
            why = "left out by the caller" if left_out else "nothing that it could change"
            steps.append(PlanStep(stage, False, why, "" if left_out else "not judged"))
            continue
        first = model.position_of(name)
        at = list(range(first, first + (HARMONICS if name == "environment" else 1)))
        plain = 1.0 if name == "occlusion" or (name == "rough" and model.brdf == "minnaert") else 0.0
        mean, deviation = np.array([known[k] for k in at]).T
        away, own = x[at] - plain, covariance[np.ix_(at, at)]
        prior = -0.5 * float((((plain - mean) / deviation) ** 2).sum()) - float(np.log(deviation).sum())
        own = own + np.diag(1e-9 * deviation**2)
        misfit = float(away @ np.linalg.solve(own, away))
        posterior = -(misfit + float(np.linalg.slogdet(own)[1])) / 2
        evidence = f"log odds {prior - posterior:.1f}"
        steps.append(PlanStep(stage, True, "in the model, as its prior allows", evidence))
    return steps


def light_prior(
    model: LightModel, x: FloatArray, log_level: float, level_sd: float, skin: bool, soft: float
) -> PriorOfLight:
    """Return the prior at x = [light, scale, likeness]; see `distributions`."""
    rows = distributions(model, float(x[-2]), log_level, level_sd, skin, soft)
    rows.append((len(x) - 1, *LIKENESS))
    at = np.array([row[0] for row in rows])
    mean, deviation = np.array([row[1:] for row in rows]).T
    away = (x[at] - mean) / deviation
    cost = float(away @ away) / 2 + float(np.log(deviation * math.sqrt(2 * math.pi)).sum())
    # Lamps shine from any direction, in any order, and each more is half as probable.
    cost += model.lights * math.log(8 * math.pi) - math.lgamma(model.lights + 1)
    slope, curvature = np.zeros(len(x)), np.full(len(x), TINY)
    slope[at] += away / deviation
    curvature[at] += 1 / deviation**2
    if model.has("specular"):
        # The highlight's mean and deviation grow with the scale of the albedo.
        row = int(np.flatnonzero(at == model.position_of("specular"))[0])
        by_scale = -x[at[row]] / deviation[row]
        slope[-2] += away[row] * by_scale + 1
        curvature[-2] += by_scale**2
    return PriorOfLight(cost, slope, curvature, rows)
