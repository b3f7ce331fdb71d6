"""The search for the light: lamps by the evidence for each number of them, beside soft light."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from scan2albedo.albedo.light_colour import light_colours
from scan2albedo.albedo.light_parameters import LightModel, allowed_parts
from scan2albedo.albedo.light_priors import parts_steps
from scan2albedo.albedo.lit_image import Explanation, LightFound, LitImage
from scan2albedo.albedo.node_field import Scales
from scan2albedo.albedo.posterior import EXTRA, Point, Posterior, descend
from scan2albedo.albedo.shadows import OUTLINE_BLURS
from scan2albedo.albedo.uncertainty import Alternative, apart, light_uncertainty
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.plan import PlanStep
from scan2albedo.optimization import damped_step

_STRENGTH = 2.0
"""Intensity at which one more lamp is tried."""
_SPLIT_RAD, _TURNS = (0.35, 0.7), 4
"""Half the angles between the two lamps that replace one, and along how many lines they part."""
_DARK_STRENGTH, _DARK_SCALES, _FRESH_LAMPS = 10.0, Scales(0.6, 0.6, 3.0), 2
"""The same of the first lamps in a room that is dark otherwise; what such a lamp shades is no outlier yet."""
_SAME_COSINE = 0.9
"""Lamps whose directions have a larger cosine are one at the start."""
_FOLLOWED, _KEPT = 10, 4
"""Distinct starts that take a few steps, and that go on to where the posterior is largest."""
_FIRST_SCALES = Scales(0.6, 0.6, 1.2)
"""Scales of the errors where candidates are compared: those of faces before their lamps are found."""
_CAUTION = 0.1
"""Damping of the one step by which starts are ranked: far from an optimum the model is hardly linear."""
_STEPS, _ROUNDS, _FLAT = 4, 6, 0.5
"""Evaluations of a descent between two estimates of the scales, how many of these there are at most, and the
rise of the log evidence in one after which there are no more."""
_HOPELESS = 8.0
"""Log odds against one lamp more at which no further ones are tried."""
_RADII_DEG = 6.0, 12.0, 20.0, 30.0
"""Angular radii of lamps that are tried: a softbox of 0.5 m at 1.2 m has 12 degrees."""
_TEMPER, _ALIKE = 0.25, 0.003
"""What the log odds of explanations are multiplied by where they are averaged [1]_: texels of faces that were
left out err two to three times as much as the posterior says, as if four cells were one. And the relative
difference below which two explanations are one.

.. [1] C. Holmes, S. Walker, "Assigning a value to a power likelihood in a general Bayesian model", Biometrika
   104(2), 2017.
"""
_LEAST_EVALUATIONS = 3
"""What any answer takes, whatever the budget."""
_LAST_EVALUATIONS = 6
"""Of the descent on the finest image, which starts near its end."""


@dataclass(frozen=True)
class LightSearch:
    """Searches one image; the budget ends it with the best so far."""

    scene: LitImage
    found: list[tuple[float, Point]] = field(default_factory=list)
    _known: dict[tuple[int, float], Posterior] = field(default_factory=dict)

    def run(self, lights: int | None) -> LightFound:
        """Return the light; `lights` None compares numbers of lamps by their evidence."""
        meter, options = self.scene.meter, self.scene.options
        if meter.exhausted:
            return self._at_once(lights or 0)
        counts = range(1, (options.maximal_lights if lights is None else lights) + 1)
        model, problem = self._model(0), self._posterior(1, OUTLINE_BLURS[0])
        first = self._settled(
            problem.start(model, model.from_lights(np.zeros((0, 3)), np.zeros(0)), problem.started(Scales()))
        )
        value, base = self._best([first, *self._variants(first)])
        best_of = {0: value}
        self._record()
        for count in counts:
            if meter.exhausted and (lights is None or count > 1):
                break
            points = self._with_one_more(base)
            best_of[count], base = self._best([*points, *self._variants(points[0])])
            self._record()
            if lights is None and best_of[count] < max(best_of.values()) - _HOPELESS:
                break
        wanted = [p for _, p in self._ranked() if lights is None or p.model.lights == base.model.lights]
        best, size = wanted[0], PlanStep("albedo.lamp_size", False, "the budget ended before it")
        if not meter.exhausted:
            best, size = self._sized(best)
        lamps = self._lamps_step(best_of, best.model.lights, lights)
        return self._explained(best, wanted, [self.scene.shadows[1], lamps, size])

    def _at_once(self, lights: int) -> LightFound:
        """Return where a few steps lead from lamps where the shading grows, whatever the budget."""
        model, problem = self._model(lights), self._posterior(0, OUTLINE_BLURS[0])
        toward = self.scene.directions[:lights]
        start = problem.start(
            model, model.from_lights(toward, np.ones(len(toward))), problem.started(Scales())
        )
        value, best = self._best([descend(start, _LEAST_EVALUATIONS, None)])
        steps = [self.scene.shadows[1], self._lamps_step({lights: value}, lights, lights or None)]
        return self._explained(best, [best], steps)

    def _ranked(self) -> list[tuple[float, Point]]:
        return sorted(self.found, key=lambda pair: -pair[0])

    def _explained(self, best: Point, wanted: list[Point], steps: list[PlanStep]) -> LightFound:
        """Return what was found, with the mean of all explanations, and the plan's rows."""
        meter, options = self.scene.meter, self.scene.options
        level, (shift, spread) = wanted[0].problem.level, self._averaged(wanted)
        first = self._ranked()[0][0]
        others = [
            Alternative(point.solution().hypothesis.lights(), round(first - value, 3))
            for value, point in self._ranked()
            if point.model.lights == best.model.lights > 0
            and _TEMPER * (first - value) < 1
            and len(apart([best.solution(), point.solution()], 2)) > 1
        ]
        if not meter.exhausted:
            largest = self._posterior(2, best.problem.blur)
            fine = Point(largest, best.model, best.x, largest.started(best.known.scales)).rescaled()
            best = descend(fine, _LAST_EVALUATIONS, meter).rescaled()
        self._record()
        colours = light_colours(best, options.choice("albedo.light_colour"))
        rows = parts_steps(best.model, best.x, best.covariance(), best.prior.rows, options)
        return LightFound(
            best.solution(),
            best.problem.level.unit,
            [*steps, *rows, colours.step],
            self.scene.shadows[0],
            light_uncertainty(best, others),
            Explanation(best, colours, level, shift, spread),
        )

    def _averaged(self, wanted: list[Point]) -> tuple[FloatArray, FloatArray]:
        """Return (N, 3) what the mean log light of all explanations adds to the first, and (N,) their spread.

        The colours are those of the first few.
        """
        known, values, fields = {id(p): value for value, p in self.found}, list[float](), list[FloatArray]()
        tints, choice = list[FloatArray](), self.scene.options.choice("albedo.light_colour")
        for point in wanted:
            # What is left of V without the highlight and the light is albedo.
            field = np.log(point.light) - np.log(point.left_of_highlight())
            field -= np.average(field, weights=point.problem.level.weight)
            # Descents from several starts meet.
            if all(np.std(field - other) > _ALIKE for other in fields):
                values.append(known[id(point)])
                fields.append(field)
                if len(tints) < _KEPT:
                    tints.append(light_colours(point, choice).ratio)
        weights = np.exp(_TEMPER * (np.array(values) - max(values)))
        weights /= weights.sum()
        beside_first, first_few = np.array(fields) - fields[0], weights[: len(tints)]
        shift = weights @ beside_first
        colour = np.average(np.array(tints) - tints[0], axis=0, weights=first_few)
        return shift[:, None] + colour, np.sqrt(weights @ (beside_first - shift) ** 2)

    def _lamps_step(self, best_of: dict[int, float], count: int, asked: int | None) -> PlanStep:
        least = best_of[min(best_of)]
        odds = ", ".join(f"{n}: {value - least:.1f}" for n, value in best_of.items())
        evidence = f"log odds against no lamp by number of lamps {odds}"
        if asked is not None:
            short = "" if count == asked else f", {count} found before the budget ended"
            return PlanStep("albedo.lights", True, f"{asked} asked for{short}", evidence)
        what = f"{count} lamp(s) beside soft light" if count else "soft light explains the image"
        return PlanStep("albedo.lights", count > 0, what, evidence)

    def _sized(self, point: Point) -> tuple[Point, PlanStep]:
        """Return the best point over the angular radii of its lamps, and the plan's row."""
        stage, choice = "albedo.lamp_size", self.scene.options.choice("albedo.lamp_size")
        if choice is False:
            return point, PlanStep(stage, False, "left out by the caller")
        if not point.model.lights or self.scene.shadows[0] is None:
            return point, PlanStep(stage, False, "no lamp that casts shadows", "not judged")
        best = point
        for radius in _RADII_DEG:
            model = replace(point.model, radius_deg=radius)
            start = Point(point.problem, model, point.x, point.known)
            tried = descend(start, 4, self.scene.meter)
            if tried.cost > best.cost:
                break
            best = tried
        evidence = f"log odds {point.cost - best.cost:.1f} for a radius of {best.model.radius_deg:g} deg"
        return best, PlanStep(stage, best is not point, "how wide the outlines of shadows are", evidence)

    def _best(self, points: list[Point]) -> tuple[float, Point]:
        """Keep points, and return the most evident one with its log evidence."""
        pairs = [(point.log_evidence(), point) for point in points]
        self.found.extend(pairs)
        return max(pairs, key=lambda pair: pair[0])

    def _record(self) -> None:
        """Add a trace row: the perplexity of a cell under the best explanation so far."""
        value, point = max(self.found, key=lambda pair: pair[0])
        cells = len(point.error) / point.problem.repeats
        self.scene.meter.record(math.exp(-value / cells))

    def _model(self, lights: int) -> LightModel:
        model = self.scene.model(lights)
        for part in allowed_parts(self.scene.brdf, self.scene.options):
            if part not in ("occlusion", "bounce") or self.scene.shadows[0] is not None:
                model = model.with_part(part)
        return model

    def _variants(self, point: Point) -> list[Point]:
        """Return the optima near a point: even ambient light, and a surface that errs otherwise."""
        model, problem = point.model.with_part("environment", False), point.problem
        surfaces = [self._posterior(1, blur) for blur in OUTLINE_BLURS if blur != problem.blur]
        found = []
        for near, where in [(model, problem), *((point.model, other) for other in surfaces)]:
            if self.scene.meter.exhausted or (near == point.model and where is problem):
                continue
            if where is not problem and (self.scene.shadows[0] is None or not near.lights):
                continue
            x = np.append(point.model.extend(point.light_x, near), point.x[-EXTRA:])
            found.append(self._settled(Point(where, near, x, where.started(point.known.scales))))
        return found

    def _with_one_more(self, base: Point) -> list[Point]:
        """Return local optima with one lamp more, the most evident first."""
        meter, problem = self.scene.meter, base.problem
        coarse = self._posterior(0, problem.blur)
        model = replace(self._model(base.model.lights + 1), bounce=False)
        known = coarse.started(_FIRST_SCALES)
        ahead = list[tuple[float, FloatArray]]()
        for x in self._starts(base, model):
            if meter.exhausted and ahead:
                break
            point = Point(coarse, model, np.append(x, base.x[-EXTRA:]), known, fixed=True)
            equations = point.normal_equations()
            step = damped_step(equations, _CAUTION)
            fall = float(step @ equations.gradient) + 0.5 * float(step @ equations.matrix @ step)
            ahead.append((point.cost + min(fall, 0.0), point.x + step))
        points = self._points(coarse, model, _distinct(model, ahead, _FOLLOWED), _FIRST_SCALES)
        fresh = list[Point]()
        if model.lights <= _FRESH_LAMPS and not meter.exhausted:
            # A lamp in a dark room is far from soft light: its own cost ranks it, not a predicted one.
            away = [(p.cost, p.x) for p in self._in_the_dark(base, model)]
            dark = self._points(coarse, model, _distinct(model, away, _KEPT), _DARK_SCALES)
            fresh = sorted((descend(p, _STEPS, meter) for p in dark), key=lambda p: p.cost)[:1]
        tried = sorted((descend(p, _STEPS, meter) for p in points), key=lambda p: p.cost)
        full, found = self._model(base.model.lights + 1), list[Point]()
        for start in [*tried[: _KEPT - len(fresh)], *fresh]:
            if found and meter.exhausted:
                break
            x = np.append(model.extend(start.light_x, full), start.x[-EXTRA:])
            point = Point(problem, full, x, problem.started(start.known.scales))
            found.append(point if meter.exhausted else self._settled(point))
        return sorted(found, key=lambda point: -point.log_evidence())

    def _points(
        self, problem: Posterior, model: LightModel, starts: list[FloatArray], scales: Scales
    ) -> list[Point]:
        """Return the points of starts x, at least one, as long as the budget lasts."""
        found, known = list[Point](), problem.started(scales)
        for x in starts:
            if found and self.scene.meter.exhausted:
                break
            found.append(Point(problem, model, x, known))
        return found

    def _settled(self, point: Point) -> Point:
        """Return the optimum near a point, with the scales that the image has there."""
        value = -math.inf
        for _ in range(_ROUNDS):
            point = descend(point, _STEPS, self.scene.meter).rescaled()
            before, value = value, point.log_evidence()
            if value - before < _FLAT or self.scene.meter.exhausted:
                break
        return point

    def _in_the_dark(self, base: Point, model: LightModel) -> Iterator[Point]:
        """Yield the starts of one strong lamp more in a room without other light."""
        count, coarse = base.model.lights, self._posterior(0, base.problem.blur)
        rows, known = base.solution().hypothesis.rows[:, :3], coarse.started(_DARK_SCALES)
        for direction in self.scene.directions:
            if self.scene.meter.exhausted:
                return
            if count and (rows @ direction).max() > _SAME_COSINE:
                continue
            plain = model.from_lights(np.vstack([rows, direction]), np.full(count + 1, _DARK_STRENGTH))
            plain[: 3 * count] = base.x[: 3 * count]
            at = slice(3 * count, 3 * count + 2)
            plain[at] = coarse.lattice.nearest(plain[at])
            yield coarse.start(model, plain, known)

    def _starts(self, base: Point, model: LightModel) -> list[FloatArray]:
        """Return the starts x of one lamp more: everywhere, or in place of one that is there."""
        count, found, lattice = base.model.lights, [], self._posterior(0, base.problem.blur).lattice
        head, rows = base.x[: 3 * count], base.solution().hypothesis.rows
        tail = base.model.extend(base.x[:-EXTRA], model)[3 * count :]
        for direction in self.scene.directions:
            if count and (rows[:, :3] @ direction).max() > _SAME_COSINE:
                continue
            at = lattice.nearest(np.array(model.coordinates(direction)))
            found.append(np.concatenate([head, at, [math.log(_STRENGTH)], tail]))
        for lamp in range(count):
            px, py, log_strength = head[3 * lamp : 3 * lamp + 3]
            for half in _SPLIT_RAD:
                for turn in np.arange(_TURNS) * math.pi / _TURNS:
                    dx, dy, each = half * math.cos(turn), half * math.sin(turn), log_strength - math.log(2)
                    one, other = [px + dx, py + dy, each], [px - dx, py - dy, each]
                    rest = np.delete(head, range(3 * lamp, 3 * lamp + 3))
                    found.append(np.concatenate([rest, one, other, tail]))
        return found

    def _posterior(self, size: int, blur: float) -> Posterior:
        """Return the posterior at one of the sizes; known ones are kept."""
        if (size, blur) not in self._known:
            self._known[size, blur] = self.scene.posterior(self.scene.options.sizes[size], blur)
        return self._known[size, blur]


def _distinct(model: LightModel, ahead: list[tuple[float, FloatArray]], count: int) -> list[FloatArray]:
    """Return the x of least cost of which no two have all their lamps in like directions."""
    kept, lamps = list[FloatArray](), list[FloatArray]()
    for _, x in sorted(ahead, key=lambda pair: pair[0]):
        rows = model.decode(x[:-EXTRA]).rows[:, :3]
        if not any((rows @ other.T > _SAME_COSINE).any(1).all() for other in lamps):
            kept.append(x)
            lamps.append(rows)
        if len(kept) == count:
            break
    return kept
