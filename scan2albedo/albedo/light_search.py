"""The search for the light by least squares: starts, number of lights, and the parts the model needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np

from scan2albedo.albedo.lamp_size import LAMP_SIZE, with_lamp_size
from scan2albedo.albedo.levels import cell_image
from scan2albedo.albedo.light_parameters import LightModel, Solution, cost_removed
from scan2albedo.albedo.lit_image import LightFound, LitImage
from scan2albedo.albedo.model_selection import (
    ENVIRONMENT_FLOOR,
    ENVIRONMENT_GAIN,
    LIGHT_GAIN,
    allowed_parts,
    decide_parts,
    environment_gain,
    light_evidence,
    undecided,
)
from scan2albedo.albedo.options import STARTS
from scan2albedo.albedo.residual_objective import ResidualProblem, descend, one_step
from scan2albedo.albedo.tint import Tint, tint_on
from scan2albedo.albedo.uncertainty import Alternative, Alternatives, apart, light_uncertainty
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.plan import PlanStep

_FIRST_STRENGTH, _ADDED_STRENGTH = 2.0, 0.4
"""Intensities at which the directions of the only light, and of one more, are tried."""
_SPLIT_RAD = 0.2, 0.4
"""Half the angles between the two lights that replace one."""
_CLOSER_LOOK = 0.5
"""Part of the required gain that one more light must bring on the smallest image to be tried on others."""
_NEARLY = 1.3
"""How many times the best cost soft light alone may cost for lamps to be sought beside it."""
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
        """Search for the light; `lights` None lets the evidence decide how many lamps there are."""
        meter, options = self.scene.meter, self.scene.options
        current, steps = self._environment(*self._lamps(lights), lights)
        steps = [self.scene.shadows[1], *steps]
        if meter.exhausted:
            ended = "the budget ended before it"
            late = (PlanStep(stage, False, ended) for stage in (LAMP_SIZE, "albedo.light_colour"))
            return self._found(current, _once([*steps, *undecided(current.model, options), *late]))
        return self._with_parts(current, steps)

    def _lamps(self, lights: int | None) -> tuple[Solution, PlanStep]:
        """Return lamps under ambient light, as many as asked for or as pay, and the plan's row."""
        meter, most = self.scene.meter, self.scene.options.maximal_lights if lights is None else lights
        current = self._first_light()
        decision = PlanStep("albedo.lights", True, "one light", "no second one tried")
        none = None
        if not meter.exhausted and lights is None:
            alone = self._without_lamps(self._middle, current.model)
            first = light_evidence(self._middle, current, alone)
            # Two lamps may pay where one between them does not.
            none = None if first.accepted else alone
        for _ in range(1, most):
            if meter.exhausted:
                break
            current, decision, accepted = self._one_more(current, forced=lights is not None)
            if not accepted:
                break
            self._record(current)
        if none is not None and (current.model.lights == 1 or _price(none) <= _price(current)):
            return none, PlanStep("albedo.lights", False, "no lamp: it does not pay", first.evidence)
        if lights is not None:
            found_lights = current.model.lights
            short = "" if found_lights == lights else f", {found_lights} found before the budget ended"
            decision = replace(decision, reason=f"{lights} asked for{short}")
        return current, decision

    def _without_lamps(self, problem: ResidualProblem, model: LightModel) -> Solution:
        """Return the optimum of soft light alone."""
        alone = replace(model, lights=0)
        return self._descend(problem, alone, alone.from_lights(np.zeros((0, 3)), np.zeros(0)))

    def _environment(
        self, lamps: Solution, decision: PlanStep, lights: int | None
    ) -> tuple[Solution, list[PlanStep]]:
        """Return the light with an environment, where it pays, and the plan's rows of lamps and environment.

        It is tried beside the lamps found, and lamps are tried beside it: lamps found without it stand for
        parts of it, and it may stand for a lamp.
        """
        stage = "albedo.environment"
        choice = self.scene.options.choice(stage)
        if choice is False or self.scene.meter.exhausted:
            return lamps, [decision]
        middle = self._middle
        model = lamps.model.with_part("environment")
        both = self._descend(middle, model, lamps.model.extend(lamps.x, model))
        gain = environment_gain(both, lamps)
        evidence = (
            f"it removes {100 * gain:.1f} % of the cost beside {lamps.model.lights} lamp(s) "
            f"({100 * ENVIRONMENT_GAIN:g} % asked)"
        )
        alone = self._without_lamps(middle, model) if lights is None else both
        tried = [both] if choice else [lamps, both]
        if lights is None:
            # Optima with the weakest lamp left out, one after the other.
            while tried[-1].model.lights and not self.scene.meter.exhausted:
                tried.append(self._descend(middle, *_without_weakest(tried[-1])))
        if choice is None and gain < ENVIRONMENT_GAIN and min(map(_price, [alone, *tried])) >= _price(lamps):
            return lamps, [decision, PlanStep(stage, False, "a large environment does not pay", evidence)]
        if lights is None:
            # Where soft light alone leaves much, the lamps found without it are better starts.
            near = _price(alone) < _NEARLY * min(map(_price, tried))
            tried.append(alone)
            accepted = near
            while accepted and alone.model.lights < self.scene.options.maximal_lights:
                if self.scene.meter.exhausted:
                    break
                alone, _, accepted = self._one_more(alone, forced=False)
                tried += [alone] if accepted else []
        best = min(tried, key=_price)
        self._record(best)
        count = best.model.lights
        if count != lamps.model.lights:
            decision = PlanStep(
                "albedo.lights", count > 0, f"{count} lamp(s) beside soft light", decision.evidence
            )
        if best.model.environment:
            return best, [decision]
        return best, [decision, PlanStep(stage, False, "lamps explain as much", evidence)]

    def _found(self, solution: Solution, steps: list[PlanStep]) -> LightFound:
        unit = self.scene.level(self.scene.options.sizes[0]).unit
        return LightFound(solution, unit, steps, self.scene.shadows[0])

    def _with_parts(self, current: Solution, steps: list[PlanStep]) -> LightFound:
        """Return the light with the parts of the model that the scene needs, refined on the largest image."""
        options, largest = self.scene.options, self._largest
        casts = self.scene.shadows[0] is not None
        current, size = with_lamp_size(largest, self._tint, current, casts, options.choice(LAMP_SIZE))
        current = self._descend(self._unguided, current.model, current.x)
        decided = decide_parts(self._unguided, current, options, self._tint)
        self._record(decided.solution)
        highlight = largest.at(current.model, current.x).highlight() if decided.highlight else None
        guided = largest.guided(highlight, tint_on(largest, self._tint, decided.solution))
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
        tint = Tint.of(self._unguided, best, options.choice("albedo.light_colour"))
        # Last, so that the trace ends with all evaluations spent.
        self._record(best)
        return replace(
            self._found(best, _once([*steps, size, *decided.steps, guide, tint.step])),
            colors=tint.colors,
            uncertainty=sure,
            albedo_deviation=cell_image(guided.level, cells, self.scene.image.mask),
        )

    @cached_property
    def _coarse(self) -> ResidualProblem:
        return self._smallest.guided(None, tint_on(self._smallest, self._tint))

    @cached_property
    def _first_tries(self) -> list[Solution]:
        """Optima of one light on the smallest image, best first, before colours of light are known."""
        model, problem = self.scene.model(1), self._smallest.guided(None)
        starts = (model.from_lights(d[None], np.array([_FIRST_STRENGTH])) for d in self.scene.directions)
        return self._polished(problem, model, starts, STARTS, self._record)

    @cached_property
    def _tint(self) -> Tint | None:
        """What the light does to colours, by a first estimate on the smallest image without their guide."""
        if self.scene.meter.exhausted:
            return None
        problem, lamp = self._smallest, self._first_tries[0]
        model = lamp.model
        for part in ("occlusion", "environment"):
            model = model.with_part(part)
        lit = self._descend(problem, model, lamp.model.extend(lamp.x, model))
        soft = self._without_lamps(problem, model)
        if self.scene.meter.exhausted:
            return None
        return Tint.of(problem, lit if cost_removed(lit.cost, soft.cost) >= LIGHT_GAIN else soft)

    @cached_property
    def _smallest(self) -> ResidualProblem:
        return self._problem(0)

    @cached_property
    def _unguided(self) -> ResidualProblem:
        return self._problem(1)

    @cached_property
    def _middle(self) -> ResidualProblem:
        return self._unguided.guided(None, tint_on(self._unguided, self._tint))

    @cached_property
    def _largest(self) -> ResidualProblem:
        return self._problem(2)

    def _problem(self, k: int) -> ResidualProblem:
        level = self.scene.level(self.scene.options.sizes[k])
        # What soft light knows of the sky spares the lamps' shadows most of their rays.
        soft = None if self.scene.meter.exhausted else self.scene.soft(level)
        return ResidualProblem(level, self.scene.lattice(level), self.scene.meter, soft)

    def _record(self, solution: Solution) -> None:
        """Add a trace row with the cost on the largest image: costs at different sizes do not compare.

        Where the budget has ended it may be the only row, and then has the cost that is known.
        """
        meter = self.scene.meter
        if not meter.exhausted:
            meter.record(self._largest.at(solution.model, solution.x).cost)
        elif not meter.rows:
            meter.record(solution.cost)

    def _descend(self, problem: ResidualProblem, model: LightModel, x: FloatArray) -> Solution:
        return descend(problem, model, x, self.scene.options.descent_iterations)

    def _first_light(self) -> Solution:
        """Return one light with every allowed part free."""
        meter, model = self.scene.meter, self.scene.model(1)
        # Builds the smallest image, which a small budget does not outlive.
        start = model.from_lights(self.scene.directions[:1], np.array([_FIRST_STRENGTH]))
        if meter.exhausted:
            # Where a few steps lead on the smallest image, with its cost there.
            found = one_step(self._coarse, model, start)
            for _ in range(_LEAST_EVALUATIONS - 1):
                found = one_step(self._coarse, model, found.x)
            meter.record(found.cost)
            return found
        tried = self._first_tries
        if meter.exhausted:
            return tried[0]
        polished = [self._descend(self._middle, s.model, s.x) for s in apart(tried, 2)]
        self.alternatives.note(polished)
        best = min([*polished, tried[0]] if meter.exhausted else polished, key=lambda s: s.cost)
        self._record(best)
        for part in allowed_parts(self.scene.brdf, self.scene.options):
            # An environment, which can stand for lamps, is tried when they are found.
            alone = part in ("occlusion", "bounce") and self.scene.shadows[0] is None
            if not (meter.exhausted or alone or part == "environment"):
                freed = best.model.with_part(part)
                best = self._descend(self._middle, freed, best.model.extend(best.x, freed))
        self._record(best)
        return best

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
        # The smallest image does without the bounce, which takes half of an evaluation's time.
        plain = _with_bounce(fewer, False)
        starts = _starts_with_one_more(plain, self.scene.directions)
        more = replace(plain.model, lights=lights)
        tried = self._polished(self._coarse, more, starts, 2 * STARTS)
        before = self._descend(self._coarse, plain.model, plain.x)
        gain = cost_removed(tried[0].cost, before.cost)
        if not forced and gain < _CLOSER_LOOK * LIGHT_GAIN:
            evidence = (
                f"light {lights} removes {100 * gain:.1f} % of the cost of the smallest image "
                f"({100 * _CLOSER_LOOK * LIGHT_GAIN:g} % asked for a closer look)"
            )
            row = PlanStep(stage, True, f"{lights - 1} light(s): one more does not pay", evidence)
            return fewer, row, False
        whole = [_with_bounce(s, fewer.model.bounce) for s in apart(tried, 2)]
        polished = [self._descend(middle, s.model, s.x) for s in whole]
        if self.scene.meter.exhausted:
            row = PlanStep(
                stage, True, f"{lights - 1} light(s)", "the budget ended before one more was judged"
            )
            return fewer, row, False
        trial = min(polished, key=lambda s: s.cost)
        reduced = self._descend(middle, *_without_weakest(trial))
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
    tail = fewer.model.extend(fewer.x, model)[3 * fewer.model.lights :]

    def start(toward: FloatArray, intensities: FloatArray) -> FloatArray:
        return np.concatenate([model.from_lights(toward, intensities)[: 3 * model.lights], tail])

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


def _with_bounce(solution: Solution, bounce: bool) -> Solution:
    """Return the solution with the bounce free, at its start where it was not, or left out."""
    model = solution.model.with_part("bounce", bounce)
    return Solution(model, solution.model.extend(solution.x, model), solution.cost)


def _without_weakest(solution: Solution) -> tuple[LightModel, FloatArray]:
    """Return the model and x of one light less."""
    weakest = int(np.argmin(solution.hypothesis.rows[:, 4]))
    model = replace(solution.model, lights=solution.model.lights - 1)
    tail = solution.model.extend(solution.x, model)[3 * solution.model.lights :]
    lamps = np.delete(solution.x[: 3 * solution.model.lights], slice(3 * weakest, 3 * weakest + 3))
    return model, np.concatenate([lamps, tail])


def _once(steps: list[PlanStep]) -> list[PlanStep]:
    """Return the first row of each stage."""
    return list({step.stage: step for step in reversed(steps)}.values())[::-1]


def _price(solution: Solution) -> float:
    """Return the cost, dearer by what each lamp and an environment have to bring."""
    model = solution.model
    part = 1 - ENVIRONMENT_GAIN if model.environment else 1.0
    return (solution.cost + ENVIRONMENT_FLOOR) / (part * (1 - LIGHT_GAIN) ** model.lights)
