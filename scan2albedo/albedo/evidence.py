"""How many lights there are and which parts of the model they need: decided by what each one explains."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.levels import build_level
from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.light_task import LightFound, LightTask
from scan2albedo.albedo.problem import Problem, Solution, Yardstick, cost_removed
from scan2albedo.albedo.search import anneal, direction_grid, disagree, polish
from scan2albedo.albedo.shadow_caster import shadow_caster
from scan2albedo.core.plan import PlanStep
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import VisibilityTable, cone_directions

FloatArray = NDArray[np.float64]

_PARTS = {
    "near": ("albedo.near_light", "a finite distance of the light"),
    "rough": ("albedo.roughness", "surface roughness"),
    "specular": ("albedo.specular", "a highlight"),
}


_PAYS = {"near": 0.01, "specular": 0.01, "rough": 0.005}
"""Part of the cost that each part has to remove."""
_LIGHT_GAIN = 0.04
"""Part of the cost that one more light has to remove here, where no deviation of its direction is known."""
CLOSER_LOOK = 0.75
"""A third light is tried when it removes this part of what is asked on the smallest image."""
COARSE_STARTS, COARSE_STEP = 8, 3
"""Of this many best starts every third is polished: neighbours in rank are mostly neighbours in direction."""


@dataclass(frozen=True)
class LightSearch(LightTask):
    """Search by simplex and annealing, and the decisions it takes.

    Parameters
    ----------
    seed : int
        Of the annealing; the others are those of `LightTask`.
    """

    seed: int

    def run(self, lights: int | None) -> LightFound:
        """Search for the light.

        Parameters
        ----------
        lights : int or None
            How many; None lets the evidence decide.
        """
        options = self.options
        directions = cone_directions(options.grid_directions, self.view, options.cone_rad)
        level = build_level(self.image, self.usable, options.grid_size, options)
        caster, step = shadow_caster(self.image, level, directions, options)
        coarse, middle, fine = (self._problem(size, caster) for size in (options.grid_size, *options.sizes))
        tables = coarse.table(directions), middle.table(directions)
        yardstick = Yardstick(self.meter, lambda s: fine.cost(s.hypothesis))
        if lights is None:
            solution, rows = self._count_lights(coarse, middle, tables, yardstick)
        else:
            plain = self._search(coarse, middle, tables, self.model(lights), yardstick)
            solution, rows = self._with_parts(middle, plain, yardstick)
            rows.insert(0, PlanStep("albedo.lights", True, f"{lights} asked for"))
        yardstick.record(solution)
        best = polish(fine, solution, 2 * options.polish_evaluations, traced=True)
        yardstick.record(best)
        return LightFound(best, [step, *rows], caster)

    def _problem(self, size: int, caster: RayCaster | None) -> Problem:
        options = self.options
        return Problem(
            build_level(self.image, self.usable, size, options),
            caster,
            np.asarray(self.view),
            options.objective,
            options.shadow_offset_mm,
            self.meter,
            # A quarter of a cell of the unit sphere's image.
            direction_step=0.5 / size,
        )

    def _search(
        self,
        coarse: Problem,
        middle: Problem,
        tables: tuple[VisibilityTable, VisibilityTable],
        model: LightModel,
        yardstick: Yardstick | None = None,
    ) -> Solution:
        """Return the best plain solution: grid, polish, and annealing where the starts disagree.

        The yardstick is given when the solution would be the answer, not a trial of more lights.
        """
        options = self.options
        starts = direction_grid(coarse, model, tables[0], options)
        if yardstick is not None:
            yardstick.record(starts[0])
        each = options.polish_evaluations * model.lights // 2
        tried = [polish(coarse, start, each) for start in starts]
        tried.sort(key=lambda s: s.cost)
        polished = [polish(middle, start, each) for start in tried[:2]]
        best = min(polished, key=lambda s: s.cost)
        if yardstick is not None:
            yardstick.record(best)
        if options.refiner == "annealing" or (options.refiner == "auto" and disagree(polished)):
            annealed = anneal(middle, best, tables[1], self.seed, options)
            polished.append(polish(middle, annealed, each))
        return min(polished, key=lambda s: s.cost)

    def _coarse_gain(
        self, coarse: Problem, plain: Solution, table: VisibilityTable, evaluations: int
    ) -> float:
        """Return which part of the cost one more light removes on the smallest image.

        It is added to the lights of `plain` from every tabulated direction; some of the best starts are
        polished, and so is `plain`.
        """
        rows, model = plain.hypothesis.rows, self.model(plain.model.lights + 1)
        seen = [table.nearest(row[:3]) for row in rows]
        starts = []
        for k, direction in enumerate(table.directions):
            for intensity in self.options.grid_strengths[:2]:
                x = model.from_lights(np.vstack([rows[:, :3], direction]), np.append(rows[:, 4], intensity))
                starts.append((coarse.cost(model.decode(x), np.stack([*seen, table.visibility[k]])), x))
        starts.sort(key=lambda start: start[0])
        tried = [
            polish(coarse, Solution(model, x, c), evaluations) for c, x in starts[:COARSE_STARTS:COARSE_STEP]
        ]
        fewer = polish(coarse, replace(plain, cost=math.inf), evaluations)
        return cost_removed(min(solution.cost for solution in tried), fewer.cost)

    def _count_lights(
        self,
        coarse: Problem,
        middle: Problem,
        tables: tuple[VisibilityTable, VisibilityTable],
        yardstick: Yardstick,
    ) -> tuple[Solution, list[PlanStep]]:
        """Add lights while each removes enough of the cost."""
        options, stage = self.options, "albedo.lights"
        wanted = max(options.light_gain, _LIGHT_GAIN)
        plain = self._search(coarse, middle, tables, self.model(1), yardstick)
        current, rows = self._with_parts(middle, plain, yardstick)
        decision = PlanStep(stage, True, "one light", "no second one tried")
        for lights in range(2, options.maximal_lights + 1):
            if self.meter.exhausted:
                break
            each = options.polish_evaluations * lights
            if lights > 2:
                glimpsed = self._coarse_gain(coarse, plain, tables[0], each)
                if glimpsed < CLOSER_LOOK * wanted:
                    decision = PlanStep(
                        stage,
                        True,
                        f"{lights - 1} lights: one more does not pay",
                        f"light {lights} removes {100 * glimpsed:.1f} % of the cost of the smallest image "
                        f"({100 * CLOSER_LOOK * wanted:g} % asked for a closer look)",
                    )
                    break
            plain = self._search(coarse, middle, tables, self.model(lights))
            trial, trial_rows = self._with_parts(middle, plain)
            same = replace(current.model, lights=lights)
            inherited = polish(middle, Solution(same, plain.model.extend(plain.x, same), math.inf), each)
            # Parts that pay together need not pay one by one: try those of fewer lights as well.
            inherited, more_rows = self._with_parts(middle, inherited)
            if inherited.cost < trial.cost:
                decided = {row.stage for row in more_rows}
                kept_rows = [row for row in rows if row.ran and row.stage not in decided]
                trial, trial_rows = inherited, [*kept_rows, *more_rows]
            # Both have to be equally well polished for their costs to be compared.
            trial, current = polish(middle, trial, each), polish(middle, current, each)
            gain = cost_removed(trial.cost, current.cost)
            intensities = trial.hypothesis.rows[:, 4]
            share = float(intensities.min() / intensities.max())
            evidence = (
                f"light {lights} removes {100 * gain:.1f} % of the cost ({100 * wanted:g} %"
                f" asked), {100 * share:.0f} % as strong as the strongest ({100 * options.light_share:g} %)"
            )
            if gain < wanted or share < options.light_share:
                decision = PlanStep(stage, True, f"{lights - 1} light(s): one more does not pay", evidence)
                break
            current, rows = trial, trial_rows
            yardstick.record(current)
            decision = PlanStep(stage, True, f"{lights} lights", evidence)
        return current, [decision, *rows]

    def _with_parts(
        self, problem: Problem, base: Solution, yardstick: Yardstick | None = None
    ) -> tuple[Solution, list[PlanStep]]:
        """Free distance, roughness and highlight one after another, the most useful first, while it pays."""
        options = self.options
        asked = {"near": options.near_light, "specular": options.specular, "rough": options.roughness}
        if self.brdf == "lambert":
            del asked["rough"]
        rows, current = [], base
        for part, choice in asked.items():
            if choice is not None:
                rows.append(
                    PlanStep(_PARTS[part][0], choice, "asked for" if choice else "left out by the caller")
                )
            if choice and not getattr(current.model, part):
                current = self._free(problem, current, part)
        pay = {
            "near": _PAYS["near"],
            "specular": _PAYS["specular"],
            "rough": _PAYS["rough"],
        }
        wanted = {
            part: pay[part]
            for part, choice in asked.items()
            if choice is None and not getattr(base.model, part)
        }
        while wanted:
            trials = {part: self._free(problem, current, part) for part in wanted}
            gains = {part: cost_removed(trial.cost, current.cost) for part, trial in trials.items()}
            best = max(wanted, key=lambda part: gains[part] / wanted[part])
            if gains[best] < wanted[best]:
                break
            current = trials[best]
            if yardstick is not None:
                yardstick.record(current)
            rows.append(_part_row(best, True, gains[best], wanted.pop(best)))
        rows += [_part_row(part, False, gains[part], asked) for part, asked in wanted.items()]
        return current, rows

    def _free(self, problem: Problem, base: Solution, part: str) -> Solution:
        model = base.model.with_part(part)
        start = Solution(model, base.model.extend(base.x, model), math.inf)
        trial = polish(problem, start, self.options.polish_evaluations)
        return trial if np.isfinite(trial.cost) else Solution(model, start.x, base.cost)


def _part_row(part: str, ran: bool, gain: float, asked: float) -> PlanStep:
    stage, what = _PARTS[part]
    reason = f"{what} explains the image better" if ran else f"{what} does not pay"
    return PlanStep(stage, ran, reason, f"removes {100 * gain:.2f} % of the cost, {100 * asked:g} % asked")
