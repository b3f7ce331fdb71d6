"""The search for the light by least squares: starts, number of lights, and the parts the model needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np

from scan2albedo.albedo.levels import cell_image
from scan2albedo.albedo.light_parameters import LightModel, Solution, cost_removed
from scan2albedo.albedo.lit_image import LightFound, LitImage
from scan2albedo.albedo.model_selection import (
    LIGHT_GAIN,
    allowed_parts,
    decide_parts,
    light_evidence,
    undecided,
)
from scan2albedo.albedo.residual_objective import ResidualProblem, descend, one_step
from scan2albedo.albedo.uncertainty import Alternative, Alternatives, apart, light_uncertainty
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.plan import PlanStep

_FIRST_STRENGTH, _ADDED_STRENGTH = 2.0, 0.4
"""Intensities at which the directions of the only light, and of one more, are tried."""
_SPLIT_RAD = 0.2, 0.4
"""Half the angles between the two lights that replace one."""
_CLOSER_LOOK = 0.5
"""Part of the required gain that one more light must bring on the smallest image to be tried on others."""
_LAST_EVALUATIONS = 8
"""Of the descent on the largest image, which starts near its end."""
_LEAST_EVALUATIONS = 4
"""What any answer takes, whatever the budget: a step toward the light from where the shading grows."""


@dataclass(frozen=True)
class LightSearch:
    """Least squares from several starts on growing images; the budget ends it with the best so far."""

    scene: LitImage
    alternatives: Alternatives = field(default_factory=Alternatives)

    def run(self, lights: int | None) -> LightFound:
        """Search for the light; `lights` None lets the evidence decide how many there are."""
        meter, options = self.scene.meter, self.scene.options
        current = self._first_light()
        decision = PlanStep("albedo.lights", True, "one light", "no second one tried")
        for _ in range(1, options.maximal_lights if lights is None else lights):
            if meter.exhausted:
                break
            trial, decision, accepted = self._one_more(current, forced=lights is not None)
            current = trial
            if not accepted:
                break
            self._record(current)
        if lights is not None:
            found = current.model.lights
            short = "" if found == lights else f", {found} found before the budget ended"
            decision = replace(decision, reason=f"{lights} asked for{short}")
        steps = [self.scene.shadows[1], decision]
        if meter.exhausted:
            return self._found(current, [*steps, *undecided(current.model, options)])
        return self._with_parts(current, steps)

    def _found(self, solution: Solution, steps: list[PlanStep]) -> LightFound:
        unit = self.scene.level(self.scene.options.sizes[0]).unit
        return LightFound(solution, unit, steps, self.scene.shadows[0])

    def _with_parts(self, current: Solution, steps: list[PlanStep]) -> LightFound:
        """Return the light with the parts of the model that the scene needs, refined on the largest image."""
        options, largest = self.scene.options, self._largest
        current = self._descend(self._unguided, current.model, current.x)
        decided = decide_parts(self._unguided, current, options)
        self._record(decided.solution)
        highlight = largest.at(current.model, current.x).highlight() if decided.highlight else None
        guided = largest.guided(highlight)
        best = descend(guided, decided.solution.model, decided.solution.x, _LAST_EVALUATIONS)
        best = best if math.isfinite(best.cost) else decided.solution
        explained = guided.guide.explained
        guide = PlanStep(
            "albedo.color_guide",
            explained > 0,
            "pigment shows in the hue" if explained > 0 else "hue tells nothing of the texture",
            f"colour explains {100 * explained:.0f} % of the local change of brightness",
        )
        sure, cells = light_uncertainty(guided, best, self.alternatives.of(best))
        # Last, so that the trace ends with all evaluations spent.
        self._record(best)
        return replace(
            self._found(best, [*steps, *decided.steps, guide]),
            uncertainty=sure,
            albedo_deviation=cell_image(guided.level, cells, self.scene.image.mask),
        )

    @cached_property
    def _coarse(self) -> ResidualProblem:
        return self._problem(0).guided(None)

    @cached_property
    def _unguided(self) -> ResidualProblem:
        return self._problem(1)

    @cached_property
    def _middle(self) -> ResidualProblem:
        return self._unguided.guided(None)

    @cached_property
    def _largest(self) -> ResidualProblem:
        return self._problem(2)

    def _problem(self, k: int) -> ResidualProblem:
        level = self.scene.level(self.scene.options.sizes[k])
        return ResidualProblem(level, self.scene.lattice(level), self.scene.meter)

    def _record(self, solution: Solution) -> None:
        """Add a trace row with the cost on the largest image: costs at different sizes do not compare."""
        meter = self.scene.meter
        if not (meter.exhausted and meter.rows):
            meter.record(self._largest.at(solution.model, solution.x).cost)

    def _descend(self, problem: ResidualProblem, model: LightModel, x: FloatArray) -> Solution:
        return descend(problem, model, x, self.scene.options.descent_iterations)

    def _first_light(self) -> Solution:
        """Return one light with every allowed part free."""
        meter, model = self.scene.meter, self.scene.model(1)
        starts = (model.from_lights(d[None], np.array([_FIRST_STRENGTH])) for d in self.scene.directions)
        if meter.exhausted:
            return self._least(next(starts), model)
        tried = self._polished(self._coarse, model, starts, self.scene.options.starts, self._record)
        polished = [self._descend(self._middle, s.model, s.x) for s in apart(tried, 2)]
        self.alternatives.note(polished)
        best = min([*polished, tried[0]] if meter.exhausted else polished, key=lambda s: s.cost)
        self._record(best)
        for part in allowed_parts(self.scene.brdf, self.scene.options):
            if not meter.exhausted:
                freed = best.model.with_part(part)
                best = self._descend(self._middle, freed, best.model.extend(best.x, freed))
        self._record(best)
        return best

    def _least(self, x: FloatArray, model: LightModel) -> Solution:
        """Return where a few steps lead on the smallest image, and record its cost there."""
        found = one_step(self._coarse, model, x)
        for _ in range(_LEAST_EVALUATIONS - 1):
            found = one_step(self._coarse, model, found.x)
        self.scene.meter.record(found.cost)
        return found

    def _polished(
        self,
        problem: ResidualProblem,
        model: LightModel,
        starts: Iterable[FloatArray],
        count: int,
        on_first: Callable[[Solution], None] | None = None,
    ) -> list[Solution]:
        """Return local minima, best first, from the distinct starts that one step improves most."""
        meter, ahead = self.scene.meter, list[Solution]()
        for x in starts:
            if meter.exhausted and ahead:
                break
            ahead.append(one_step(problem, model, x))
        chosen = apart(sorted(ahead, key=lambda s: s.cost), count)
        if on_first is not None:
            on_first(chosen[0])
        descended = (self._descend(problem, s.model, s.x) for s in chosen)
        # A budget that has ended leaves infinite costs: the prediction is then what is known.
        known = (d if math.isfinite(d.cost) else s for d, s in zip(descended, chosen, strict=True))
        return sorted(known, key=lambda s: s.cost)

    def _one_more(self, fewer: Solution, *, forced: bool) -> tuple[Solution, PlanStep, bool]:
        """Return the solution with one more light, the plan's row, and whether it is worth it."""
        stage, lights, middle = "albedo.lights", fewer.model.lights + 1, self._middle
        starts = _starts_with_one_more(fewer, self.scene.directions)
        more = replace(fewer.model, lights=lights)
        tried = self._polished(self._coarse, more, starts, 2 * self.scene.options.starts)
        before = self._descend(self._coarse, fewer.model, fewer.x)
        gain = cost_removed(tried[0].cost, before.cost)
        if not forced and gain < _CLOSER_LOOK * LIGHT_GAIN:
            evidence = (
                f"light {lights} removes {100 * gain:.1f} % of the cost of the smallest image "
                f"({100 * _CLOSER_LOOK * LIGHT_GAIN:g} % asked for a closer look)"
            )
            row = PlanStep(stage, True, f"{lights - 1} light(s): one more does not pay", evidence)
            return fewer, row, False
        polished = [self._descend(middle, s.model, s.x) for s in apart(tried, 2)]
        if self.scene.meter.exhausted:
            row = PlanStep(
                stage, True, f"{lights - 1} light(s)", "the budget ended before one more was judged"
            )
            return fewer, row, False
        trial = min(polished, key=lambda s: s.cost)
        reduced = self._descend(middle, fewer.model, _without_weakest(trial))
        if reduced.cost < fewer.cost:
            # The way over one more light led out of a local minimum.
            fewer = reduced
        found = light_evidence(middle, trial, fewer)
        if found.one_or_two:
            self.alternatives.split.append(Alternative(trial.hypothesis.lights(), -found.gain))
        if not forced and not found.accepted:
            row = PlanStep(stage, True, f"{lights - 1} light(s): one more does not pay", found.evidence)
            return fewer, row, False
        return trial, PlanStep(stage, True, f"{lights} lights", found.evidence), True


def _starts_with_one_more(fewer: Solution, directions: FloatArray) -> Iterable[FloatArray]:
    """Yield starts with one more light: a weak one from every direction, and each light split in two."""
    model = replace(fewer.model, lights=fewer.model.lights + 1)
    rows = fewer.hypothesis.rows
    tail = fewer.x[3 * fewer.model.lights :]

    def start(toward: FloatArray, intensities: FloatArray) -> FloatArray:
        x = model.from_lights(toward, intensities)
        x[3 * model.lights :] = tail
        return x

    for direction in directions:
        yield start(np.vstack([rows[:, :3], direction]), np.append(rows[:, 4], _ADDED_STRENGTH))
    for k in range(len(rows)):
        others = np.delete(rows, k, 0)
        p = fewer.x[3 * k : 3 * k + 2]
        for half, angle in product(_SPLIT_RAD, np.arange(4) * math.pi / 4):
            shift = half * np.array([math.cos(angle), math.sin(angle)])
            pair = np.stack([model.direction(*(p + shift)), model.direction(*(p - shift))])
            yield start(
                np.vstack([others[:, :3], pair]), np.append(others[:, 4], np.repeat(rows[k, 4] / 2, 2))
            )


def _without_weakest(solution: Solution) -> FloatArray:
    """Return x of one light less."""
    lights = solution.model.lights
    weakest = int(np.argmin(solution.hypothesis.rows[:, 4]))
    return np.delete(solution.x, slice(3 * weakest, 3 * weakest + 3)) if lights > 1 else solution.x
