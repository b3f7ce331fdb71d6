"""The search for the light by least squares: starts, number of lights, and the parts the model needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.evidence import LightFound
from scan2albedo.albedo.first_light import hasty_light, nearest_first, shading_direction
from scan2albedo.albedo.levels import Level, brightest_around, build_level, cell_image
from scan2albedo.albedo.levenberg_marquardt import descend, promise
from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.parts import PartsDecided, albedo_change, allowed_parts, decide_parts, undecided
from scan2albedo.albedo.problem import Solution, Yardstick, cost_removed
from scan2albedo.albedo.residual_problem import ResidualProblem
from scan2albedo.albedo.shadow_caster import shadow_caster
from scan2albedo.albedo.uncertainty import Alternative, light_uncertainty
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.geometry_image import GeometryImage
from scan2albedo.lighting.shadow_map import cone_directions
from scan2albedo.optimization import Meter
from scan2albedo.optimization.plan import PlanStep

FloatArray = NDArray[np.float64]

_FIRST_STRENGTH, _ADDED_STRENGTH = 2.0, 0.4
"""Intensity of the light at which a direction is tried: of the only light, of one more."""
_NEARLY_AS_GOOD, _ELSEWHERE_RAD = 0.03, 0.2
"""An alternative costs more by less than this part, and its lights are this far away."""
_SPLIT_RAD = 0.2, 0.4
"""Half the angles between the two lights that replace one."""


@dataclass(frozen=True)
class LeastSquaresSearch:
    """Search by least squares; `evidence.LightSearch` is the former one, by simplex and annealing.

    Parameters
    ----------
    image : GeometryImage
    usable : (H, W) bool
    brdf : str
    view : (float, float, float)
        Unit.
    options : EstimateOptions
    meter : Meter
    """

    image: GeometryImage
    usable: NDArray[np.bool_]
    brdf: str
    view: tuple[float, float, float]
    options: EstimateOptions
    meter: Meter

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
        model = self._model(1)
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
    def _alternatives(self) -> _Alternatives:
        return _Alternatives([], [])

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

    def _model(self, lights: int) -> LightModel:
        position = self.image.position[self.image.mask]
        radius = float(np.linalg.norm(position, axis=1).max()) or 1.0
        return LightModel(lights, self.brdf, self.view, radius)

    def _first_light(
        self, coarse: ResidualProblem, middle: ResidualProblem, yardstick: Yardstick
    ) -> Solution:
        """Return one light with every allowed part free."""
        model = self._model(1)
        starts = (model.from_lights(d[None], np.array([_FIRST_STRENGTH])) for d in self._directions)
        tried = self._polished(coarse, model, starts, self.options.starts, yardstick.record)
        polished = [self._descend(middle, s.model, s.x) for s in _apart(tried, 2)]
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
        chosen = _apart(sorted(promising, key=lambda s: s.cost), count)
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
        tried = self._polished(
            coarse, replace(fewer.model, lights=lights), self._added(fewer), 2 * options.starts
        )
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
        polished = [self._descend(middle, s.model, s.x) for s in _apart(tried, 2)]
        if self.meter.exhausted:
            row = PlanStep(
                stage, True, f"{lights - 1} light(s)", "the budget ended before one more was judged"
            )
            return fewer, row, False
        trial = min(polished, key=lambda s: s.cost)
        reduced = self._descend(middle, fewer.model, _without_weakest(trial))
        if reduced.cost < fewer.cost:
            # The way over one more light led out of a local minimum.
            fewer = reduced
        gain = cost_removed(trial.cost, fewer.cost)
        intensities = trial.hypothesis.rows[:, 4]
        share = float(intensities.min() / intensities.max())
        effect = albedo_change(middle, trial, fewer)
        evidence = (
            f"light {lights} removes {100 * gain:.1f} % of the cost ({100 * wanted:g} % asked), changes the "
            f"albedo by {100 * effect:.2f} % ({100 * options.light_effect:g} % asked), "
            f"{100 * share:.0f} % as strong as the strongest ({100 * options.light_share:g} % asked)"
        )
        apart, spread = _smallest_angle(trial), _direction_deviation(middle, trial)
        evidence += (
            f", {math.degrees(apart):.0f} deg from the next, its direction known to "
            f"{math.degrees(spread):.1f} deg ({math.degrees(options.light_direction_rad):.1f} asked)"
        )
        pays = (
            gain >= wanted
            and share >= options.light_share
            and effect >= options.light_effect
            and spread <= options.light_direction_rad
        )
        if pays and apart < options.light_angle_rad:
            # One broad light, or two: the picture does not tell, and the albedo depends on it.
            pays = False
            self._alternatives.split.append(Alternative(trial.hypothesis.lights(), -gain))
        if not forced and not pays:
            row = PlanStep(stage, True, f"{lights - 1} light(s): one more does not pay", evidence)
            return fewer, row, False
        return trial, PlanStep(stage, True, f"{lights} lights", evidence), True

    def _added(self, fewer: Solution) -> Iterable[FloatArray]:
        """Yield starts with one more light: a weak one from every direction, and each light split in two."""
        model = replace(fewer.model, lights=fewer.model.lights + 1)
        rows = fewer.hypothesis.rows
        tail = fewer.x[3 * fewer.model.lights :]

        def start(directions: FloatArray, intensities: FloatArray) -> FloatArray:
            x = model.from_lights(directions, intensities)
            x[3 * model.lights :] = tail
            return x

        for direction in self._directions:
            yield start(np.vstack([rows[:, :3], direction]), np.append(rows[:, 4], _ADDED_STRENGTH))
        for k in range(len(rows)):
            others = np.delete(rows, k, 0)
            p = fewer.x[3 * k : 3 * k + 2]
            for apart, angle in product(_SPLIT_RAD, np.arange(4) * math.pi / 4):
                shift = apart * np.array([math.cos(angle), math.sin(angle)])
                pair = np.stack([model.direction(*(p + shift)), model.direction(*(p - shift))])
                yield start(
                    np.vstack([others[:, :3], pair]), np.append(others[:, 4], np.repeat(rows[k, 4] / 2, 2))
                )


@dataclass(frozen=True)
class _Alternatives:
    """Local minima of equal models that were found on the way, and lights that may be two close ones."""

    found: list[list[Solution]]
    split: list[Alternative]

    def note(self, minima: list[Solution]) -> None:
        """Keep the minima of one descent from several starts."""
        self.found.append(sorted(minima, key=lambda s: s.cost))

    def of(self, best: Solution) -> list[Alternative]:
        """Return splits, and those with as many lights as `best`, elsewhere, that cost little more."""
        result = list(self.split)
        for minima in self.found:
            for other in minima:
                excess = -cost_removed(other.cost, minima[0].cost)
                same = len(_apart([best, other], 2, _ELSEWHERE_RAD)) == 1
                if other.model.lights == best.model.lights and not same and excess < _NEARLY_AS_GOOD:
                    result.append(Alternative(other.hypothesis.lights(), excess))
        return sorted(result, key=lambda a: a.excess)


def _smallest_angle(solution: Solution) -> float:
    """Return the smallest angle [rad] between two lights."""
    rows = solution.hypothesis.rows[:, :3]
    cosine = (rows @ rows.T)[np.triu_indices(len(rows), 1)]
    return float(np.arccos(np.clip(cosine.max(), -1, 1)))


def _direction_deviation(problem: ResidualProblem, solution: Solution) -> float:
    """Return the standard deviation [rad] of the weakest light's direction: what is no lamp has none."""
    k = 3 * int(np.argmin(solution.hypothesis.rows[:, 4]))
    variance = np.diag(problem.covariance(solution.model, solution.x))[k : k + 2]
    return math.sqrt(max(float(variance.mean()), 0.0))


def _without_weakest(solution: Solution) -> FloatArray:
    """Return x of one light less."""
    lights = solution.model.lights
    weakest = int(np.argmin(solution.hypothesis.rows[:, 4]))
    return np.delete(solution.x, slice(3 * weakest, 3 * weakest + 3)) if lights > 1 else solution.x


def _apart(solutions: list[Solution], count: int, separation_rad: float = 0.25) -> list[Solution]:
    """Return the first `count` of which no two have all their lights within `separation_rad`."""
    kept: list[Solution] = []
    cosine = math.cos(separation_rad)
    for solution in solutions:
        rows = solution.hypothesis.rows[:, :3]
        if not any((rows @ other.hypothesis.rows[:, :3].T > cosine).any(1).all() for other in kept):
            kept.append(solution)
        if len(kept) == count:
            break
    return kept
