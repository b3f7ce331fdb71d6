"""The angular size of lamps, from how wide the outlines of their shadows are."""

from __future__ import annotations

import math
from dataclasses import replace

from scan2albedo.albedo.light_parameters import Solution, cost_removed
from scan2albedo.albedo.residual_objective import ResidualProblem, descend
from scan2albedo.albedo.tint import Tint, tint_on
from scan2albedo.core.plan import PlanStep

LAMP_SIZE = "albedo.lamp_size"
_RADII_DEG = 6.0, 12.0, 20.0, 30.0
"""Angular radii that are tried: a softbox of 0.5 m at 1.2 m has 12 degrees."""
_GAIN, _EVALUATIONS = 0.005, 4
"""Part of the cost that a radius has to remove, and the evaluations of one descent, which starts near its
end. On path-traced faces 6 degrees remove 0.002 at most under small lamps, and more under large ones."""


def with_lamp_size(
    largest: ResidualProblem, tint: Tint | None, point: Solution, casts_shadows: bool, choice: bool | None
) -> tuple[Solution, PlanStep]:
    """Return the solution with the radius [deg] of its lamps that explains the outlines best, and the row.

    Only the `largest` image, without guide yet, shows how wide outlines are. Larger radii are tried while
    they explain more. `point` has point lamps; its cost, of another image, is kept. `choice` True takes a
    radius whatever the evidence, False none.
    """
    if choice is False:
        return point, PlanStep(LAMP_SIZE, False, "left out by the caller")
    if not (point.model.lights and casts_shadows):
        return point, PlanStep(LAMP_SIZE, False, "no lamp that casts shadows", "not judged")
    problem = largest.guided(None, tint_on(largest, tint))
    best, costs = point, list[float]()
    for radius_deg in (0.0, *_RADII_DEG):
        model = replace(point.model, radius_deg=radius_deg)
        found = descend(problem, model, point.x, _EVALUATIONS)
        forced = choice and len(costs) == 1
        worse = found.cost >= min(costs, default=math.inf) and not forced
        costs.append(found.cost)
        if worse:
            break
        best = found
    gain = cost_removed(best.cost, costs[0])
    pairs = zip((0.0, *_RADII_DEG), costs, strict=False)
    tries = ", ".join(f"{radius:g} deg {cost:.4f}" for radius, cost in pairs)
    evidence = f"cost by angular radius: {tries} ({100 * _GAIN:g} % less asked)"
    if problem.meter.exhausted or best.model.radius_deg == 0 or (gain < _GAIN and not choice):
        return point, PlanStep(LAMP_SIZE, False, "lamps may be points", evidence)
    reason = f"lamps have a radius of {best.model.radius_deg:g} deg"
    return replace(best, cost=point.cost), PlanStep(LAMP_SIZE, True, reason, evidence)
