"""The search for the light by least squares: starts, number of lights, and the parts the model needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.alternatives import Alternatives, apart
from scan2albedo.albedo.first_light import hasty_light, nearest_first, shading_direction
from scan2albedo.albedo.levels import Level, brightest_around, build_level, cell_image
from scan2albedo.albedo.levenberg_marquardt import descend, promise
from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.light_task import LightFound, LightTask
from scan2albedo.albedo.one_more_light import judged, starts_with_one_more, without_weakest
from scan2albedo.albedo.parts import PartsDecided, allowed_parts, decide_parts, undecided
from scan2albedo.albedo.problem import Solution, Yardstick, cost_removed
from scan2albedo.albedo.residual_problem import ResidualProblem
from scan2albedo.albedo.shadow_caster import shadow_caster
from scan2albedo.albedo.uncertainty import Alternative, light_uncertainty
from scan2albedo.core.plan import PlanStep
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import cone_directions

FloatArray = NDArray[np.float64]

_FIRST_STRENGTH = 2.0
"""Intensity at which the directions of the only light are tried."""


@dataclass(frozen=True)
class LeastSquaresSearch(LightTask):
    """Search by least squares; `evidence.LightSearch` is the former one, by simplex and annealing."""

    def run(self, lights: int | None) -> LightFound:
        """Search for the light.

        Parameters
        ----------
        lights : int or None
            How many; None lets the evidence decide.
        """
        options = self.options
        coarse = self._problem(options.grid_size).guided(None)
        if self.meter.exhausted:
            return self._hasty(coarse)
        unguided, fine = (self._problem(size) for size in options.sizes)
        middle = unguided.guided(None)
        yardstick = Yardstick(self.meter, lambda s: fine.linearize(s.model, s.x).cost)
        current = self._first_light(coarse, middle, yardstick)
        most = self.options.maximal_lights if lights is None else lights
        decision = PlanStep("albedo.lights", True, "one light", "no second one tried")
        for _ in range(1, most):
            if self.meter.exhausted:
                break
            trial, decision, accepted = self._one_more(coarse, middle, current, forced=lights is not None)
            current = trial
            if not accepted:
                break
            yardstick.record(current)
        if lights is not None:
            found = current.model.lights
            short = "" if found == lights else f", {found} found before the budget ended"
            decision = replace(decision, reason=f"{lights} asked for{short}")
        if self.meter.exhausted:
            rows = undecided(current.model, self.options)
            return LightFound(current, [self._shadows[1], decision, *rows], self._shadows[0])
        current = self._descend(unguided, current.model, current.x)
        decided = decide_parts(unguided, current, self.options, self._descend)
        yardstick.record(decided.solution)
        guided, best, step = self._finish(fine, current, decided)
        steps = [self._shadows[1], decision, *decided.steps, step]
        sure, cells = light_uncertainty(guided, best, self._alternatives.of(best))
        # Last, so that the trace ends with all evaluations spent.
        yardstick.record(best)
        deviation = cell_image(guided.level, cells, self.image.mask)
        return LightFound(best, steps, self._shadows[0], sure, deviation)

    def _hasty(self, coarse: ResidualProblem) -> LightFound:
        """Return one light, found in a few steps on the smallest image, when the budget has ended already."""
        model = self.model(1)
        start = model.from_lights(self._directions[:1], np.array([_FIRST_STRENGTH]))
        found = hasty_light(coarse, model, start)
        decision = PlanStep("albedo.lights", True, "one light", "the budget had ended before the search")
        rows = undecided(model, self.options)
        return LightFound(found, [self._shadows[1], decision, *rows], self._shadows[0])

    def _finish(
        self, fine: ResidualProblem, full: Solution, decided: PartsDecided
    ) -> tuple[ResidualProblem, Solution, PlanStep]:
        """Return the largest image with the texture that colour tells divided out, and its optimum."""
        highlight = fine.highlight(full.model, full.x) if decided.keeps_highlight else None
        guided = fine.guided(highlight)
        explained = guided.guide.explained
        evidence = f"colour explains {100 * explained:.0f} % of the local change of brightness"
        solution = decided.solution
        best = descend(guided, solution.model, solution.x, self.options.final_iterations)
        best = best if math.isfinite(best.cost) else solution
        ran = explained > 0
        reason = "pigment shows in the hue" if ran else "hue tells nothing of the texture"
        return guided, best, PlanStep("albedo.color_guide", ran, reason, evidence)

    @cached_property
    def _alternatives(self) -> Alternatives:
        return Alternatives()

    @cached_property
    def _directions(self) -> FloatArray:
        every = cone_directions(self.options.start_directions, self.view, self.options.cone_rad)
        return nearest_first(every, shading_direction(self._coarse_level))

    @cached_property
    def _value(self) -> FloatArray:
        assert self.image.texture_linear is not None
        return brightest_around(self.image.texture_linear, self.usable)

    @cached_property
    def _coarse_level(self) -> Level:
        return self._level(self.options.grid_size)

    def _level(self, size: int) -> Level:
        return build_level(self.image, self.usable, size, self.options, self._value)

    @cached_property
    def _shadows(self) -> tuple[RayCaster | None, PlanStep]:
        return shadow_caster(
            self.image, self._coarse_level, self._directions, self.options, hasty=self.meter.exhausted
        )

    def _problem(self, size: int) -> ResidualProblem:
        options = self.options
        level = self._coarse_level if size == options.grid_size else self._level(size)
        return ResidualProblem(
            level,
            self._shadows[0],
            np.asarray(self.view),
            options.shadow_offset_mm,
            options.fit_block_area / options.block_area,
            self.meter,
        )

    def _first_light(
        self, coarse: ResidualProblem, middle: ResidualProblem, yardstick: Yardstick
    ) -> Solution:
        """Return one light with every allowed part free."""
        model = self.model(1)
        starts = (model.from_lights(d[None], np.array([_FIRST_STRENGTH])) for d in self._directions)
        tried = self._polished(coarse, model, starts, self.options.starts, yardstick.record)
        polished = [self._descend(middle, s.model, s.x) for s in apart(tried, 2)]
        self._alternatives.note(polished)
        best = min([*polished, tried[0]] if self.meter.exhausted else polished, key=lambda s: s.cost)
        yardstick.record(best)
        full = self._with_all_parts(middle, best)
        yardstick.record(full)
        return full

    def _polished(
        self,
        problem: ResidualProblem,
        model: LightModel,
        starts: Iterable[FloatArray],
        count: int,
        on_first: Callable[[Solution], None] | None = None,
    ) -> list[Solution]:
        """Return local minima from the most promising, distinct starts, best first."""
        promising: list[Solution] = []
        for x in starts:
            if self.meter.exhausted and promising:
                break
            cost, ahead = promise(problem, model, x)
            promising.append(Solution(model, ahead, cost))
        chosen = apart(sorted(promising, key=lambda s: s.cost), count)
        if on_first is not None:
            on_first(chosen[0])
        descended = (self._descend(problem, s.model, s.x) for s in chosen)
        # A budget that has ended leaves infinite costs: the promise is then what is known.
        known = (d if math.isfinite(d.cost) else s for d, s in zip(descended, chosen, strict=True))
        return sorted(known, key=lambda s: s.cost)

    def _descend(self, problem: ResidualProblem, model: LightModel, x: FloatArray) -> Solution:
        return descend(problem, model, x, self.options.descent_iterations)

    def _with_all_parts(self, problem: ResidualProblem, base: Solution) -> Solution:
        """Free the allowed parts one after another."""
        current = base
        for part in allowed_parts(self.brdf, self.options):
            if not getattr(current.model, part) and not self.meter.exhausted:
                model = current.model.with_part(part)
                current = self._descend(problem, model, current.model.extend(current.x, model))
        return current

    def _one_more(
        self, coarse: ResidualProblem, middle: ResidualProblem, fewer: Solution, *, forced: bool
    ) -> tuple[Solution, PlanStep, bool]:
        """Return the solution with one more light, the plan's row, and whether it is worth it."""
        options, stage, lights = self.options, "albedo.lights", fewer.model.lights + 1
        starts = starts_with_one_more(fewer, self._directions)
        tried = self._polished(coarse, replace(fewer.model, lights=lights), starts, 2 * options.starts)
        before = self._descend(coarse, fewer.model, fewer.x)
        glimpsed = cost_removed(tried[0].cost, before.cost)
        wanted = options.light_gain
        if not forced and glimpsed < options.closer_look * wanted:
            evidence = (
                f"light {lights} removes {100 * glimpsed:.1f} % of the cost of the smallest image "
                f"({100 * options.closer_look * wanted:g} % asked for a closer look)"
            )
            return (
                fewer,
                PlanStep(stage, True, f"{lights - 1} light(s): one more does not pay", evidence),
                False,
            )
        polished = [self._descend(middle, s.model, s.x) for s in apart(tried, 2)]
        if self.meter.exhausted:
            row = PlanStep(
                stage, True, f"{lights - 1} light(s)", "the budget ended before one more was judged"
            )
            return fewer, row, False
        trial = min(polished, key=lambda s: s.cost)
        reduced = self._descend(middle, fewer.model, without_weakest(trial))
        if reduced.cost < fewer.cost:
            # The way over one more light led out of a local minimum.
            fewer = reduced
        verdict = judged(middle, trial, fewer, options)
        if verdict.one_or_two:
            self._alternatives.split.append(Alternative(trial.hypothesis.lights(), -verdict.gain))
        if not forced and not verdict.pays:
            row = PlanStep(stage, True, f"{lights - 1} light(s): one more does not pay", verdict.evidence)
            return fewer, row, False
        return trial, PlanStep(stage, True, f"{lights} lights", verdict.evidence), True
