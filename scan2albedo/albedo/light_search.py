"""The search for the light: lamps by the evidence for each number of them, beside soft light."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from scan2albedo.albedo.light_colour import light_colours
from scan2albedo.albedo.light_parameters import INTENSITY, PARTS, Hypothesis, LightModel
from scan2albedo.albedo.light_priors import parts_steps
from scan2albedo.albedo.node_field import Scales
from scan2albedo.albedo.posterior import EXTRA, NOISE, TEMPER, Point, Posterior, Start, descend
from scan2albedo.albedo.shaded_image import Explanation, LightFound, ShadedImage
from scan2albedo.albedo.shadows import OUTLINE_BLURS
from scan2albedo.albedo.uncertainty import Alternative, light_uncertainty
from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import FloatArray
from scan2albedo.optimization.least_squares import damped_step

_DARK_STRENGTH = 10.0
"""Intensity at which the first lamps are tried in a room that is dark otherwise."""
_DARK_SCALES = Scales(0.6, 0.6, 3.0)
"""Scales of the errors there: what such a lamp shades is no outlier yet."""
_FRESH_LAMPS = 2
"""Most lamps of a light that is tried so."""
_SAME_COSINE = 0.9
"""Lamps whose directions have a larger cosine are one at the start."""
_FOLLOWED = 10
"""Distinct starts that take a few steps."""
_KEPT = 4
"""Of these, starts that go on to where the posterior is largest."""
_FIRST_SCALES = Scales(0.6, 0.6, 1.2)
"""Scales of the errors where candidates are compared: those of faces before their lamps are found."""
_CAUTION = 0.1
"""Damping of the one step by which starts are ranked: far from an optimum the model is hardly linear."""
_STEPS = 4
"""Evaluations of a descent between two estimates of the scales."""
_FLAT = 0.5
"""Rise of the log evidence between two such estimates after which there are no more."""


class LightSearch:
    """Searches one image; the budget ends it with the best so far."""

    def __init__(self, scene: ShadedImage) -> None:
        self.scene, self.meter, self.options = scene, scene.meter, scene.options
        self.found = list[tuple[float, Point]]()

    def run(self, lights: int | None) -> LightFound:
        """Return the light; `lights` None compares numbers of lamps by their evidence."""
        meter, most = self.meter, self.options.maximal_lights if lights is None else lights
        # Without any time a few steps lead from lamps where the shading grows.
        late = meter.exhausted
        model = self.scene.model((lights or 0) if late else 0, PARTS)
        problem = self._posterior(0 if late else 1, OUTLINE_BLURS[0])
        toward = self.scene.directions[: model.lights]
        x = model.from_lights(toward, np.ones(len(toward)))
        start = problem.start(model, x, problem.started(Scales()))
        first = descend(start, _STEPS, None) if late else self._settled(start)
        value, base = self._best([first, *self._variants(first)])
        best_of = {model.lights: value}
        for count in range(model.lights + 1, most + 1):
            if meter.exhausted and (lights is None or count > 1):
                break
            points = self._with_one_more(base)
            best_of[count], base = self._best([*points, *self._variants(points[0])])
            # With log odds of 2 against one lamp more, no search that was seen found a better one beyond it.
            if lights is None and best_of[count] < max(best_of.values()) - 2:
                break
        ranked = sorted(self.found, key=lambda pair: -pair[0])
        wanted = [pair for pair in ranked if lights is None or pair[1].model.lights == base.model.lights]
        best, size = wanted[0][1], PlanStep("albedo.lamp_size", False, "the budget ended before it")
        if not meter.exhausted:
            best, size = self._sized(best)
        least, count = best_of[min(best_of)], best.model.lights
        odds = ", ".join(f"{n}: {value - least:.1f}" for n, value in best_of.items())
        what = f"{count} lamp(s) beside soft light" if count else "soft light explains the image"
        if lights is not None:
            what = f"{lights} asked for"
            what += "" if count == lights else f", {count} found before the budget ended"
        evidence = f"log odds against no lamp by number of lamps {odds}"
        lamps = PlanStep("albedo.lights", lights is not None or count > 0, what, evidence)
        return self._explained(best, wanted, [self.scene.shadows[1], lamps, size])

    def _explained(self, best: Point, wanted: list[tuple[float, Point]], steps: list[PlanStep]) -> LightFound:
        first, likeliest = wanted[0]
        level, (shift, spread) = likeliest.problem.level, self._averaged(wanted)
        found, others = best.solution().hypothesis, list[Alternative]()
        for value, point in wanted:
            other = point.solution().hypothesis
            if (
                TEMPER * (first - value) < 1
                and len(other.rows) == len(found.rows) > 0
                and not _same_directions(other, found, math.cos(0.25))
            ):
                others.append(Alternative(other.lights(), round(first - value, 3)))
        if not self.meter.exhausted:
            largest = self._posterior(2, best.problem.blur)
            known = largest.started(best.known.scales)
            fine = largest.at(best.model, best.x, known).rescaled()
            best = descend(fine, _STEPS, self.meter).rescaled()
        self._record()
        colours = light_colours(best, self.options.choice("albedo.light_colour"))
        rows = parts_steps(best.model, best.x, best.covariance(), best.prior, self.options)
        steps = [*steps, *rows, colours.step]
        explained = Explanation(best, colours, level, shift, spread)
        return LightFound(best.solution(), steps, light_uncertainty(best, others), explained)

    def _averaged(self, wanted: list[tuple[float, Point]]) -> tuple[FloatArray, FloatArray]:
        """Return (N,) what the mean log light of all explanations adds to the first one, and their spread."""
        values, fields = list[float](), list[FloatArray]()
        for value, point in wanted:
            # What is left of V without the highlight and the light is albedo.
            field = np.log(point.light) - np.log(point.left_of_highlight())
            field -= np.average(field, weights=point.problem.level.weight)
            # Descents from several starts meet.
            if all(np.std(field - other) > NOISE for other in fields):
                values.append(value)
                fields.append(field)
        weights = np.exp(TEMPER * (np.array(values) - max(values)))
        weights /= weights.sum()
        differences = np.array(fields) - fields[0]
        shift = weights @ differences
        return shift, np.sqrt(weights @ (differences - shift) ** 2)

    def _sized(self, point: Point) -> tuple[Point, PlanStep]:
        """Return the best point over the angular radii of its lamps, and the plan's row."""
        stage, choice = "albedo.lamp_size", self.options.choice("albedo.lamp_size")
        if choice is False:
            return point, PlanStep(stage, False, "left out by the caller")
        if not point.model.lights or self.scene.shadows[0] is None:
            return point, PlanStep(stage, False, "no lamp that casts shadows", "not judged")
        best = point
        # A softbox of 0.5 m at 1.2 m has 12 degrees.
        for radius in (6.0, 12.0, 20.0, 30.0):
            model = replace(point.model, radius_deg=radius)
            known = point.problem.started(point.known.scales, point.robust)
            tried = descend(point.problem.at(model, point.x, known), _STEPS, self.meter)
            if tried.cost > best.cost:
                break
            best = tried
        evidence = f"log odds {point.cost - best.cost:.1f} for a radius of {best.model.radius_deg:g} deg"
        return best, PlanStep(stage, best is not point, "how wide the outlines of shadows are", evidence)

    def _best(self, points: list[Point]) -> tuple[float, Point]:
        """Keep points, and return the most evident one with its log evidence."""
        pairs = [(point.log_evidence(), point) for point in points]
        self.found.extend(pairs)
        self._record()
        return max(pairs, key=lambda pair: pair[0])

    def _record(self) -> None:
        """Add a trace row: the perplexity of a cell under the best explanation so far."""
        value, point = max(self.found, key=lambda pair: pair[0])
        self.meter.record(math.exp(-value / (len(point.error) / point.problem.repeats)))

    def _variants(self, point: Point) -> list[Point]:
        """Return the optima near a point: even ambient light, and a surface that errs otherwise."""
        even, problem, found = point.model.without("environment"), point.problem, list[Point]()
        others = [(even, problem)] if even != point.model else []
        if self.scene.shadows[0] is not None and point.model.lights:
            blurs = [blur for blur in OUTLINE_BLURS if blur != problem.blur]
            others += [(point.model, self._posterior(1, blur)) for blur in blurs]
        for model, where in others:
            if self.meter.exhausted:
                break
            x = np.append(point.model.extend(point.light_x, model), point.x[-EXTRA:])
            found.append(self._settled(where.at(model, x, where.started(point.known.scales))))
        return found

    def _with_one_more(self, base: Point) -> list[Point]:
        meter, full = self.meter, self.scene.model(base.model.lights + 1, PARTS)
        model = full.without("bounce")
        tried, fresh = self._followed(base, model, False, _FOLLOWED, _FIRST_SCALES), list[Point]()
        if model.lights <= _FRESH_LAMPS and not meter.exhausted:
            fresh = self._followed(base, model, True, _KEPT, _DARK_SCALES)[:1]
        found = list[Point]()
        for start in [*tried[: _KEPT - len(fresh)], *fresh]:
            if found and meter.exhausted:
                break
            x = np.append(model.extend(start.light_x, full), start.x[-EXTRA:])
            point = base.problem.at(full, x, base.problem.started(start.known.scales))
            found.append(point if meter.exhausted else self._settled(point))
        return sorted(found, key=lambda point: -point.log_evidence())

    def _followed(
        self, base: Point, model: LightModel, dark: bool, count: int, scales: Scales
    ) -> list[Point]:
        """Return where a few steps lead from the best distinct starts, the best first."""
        meter, ranked, found = self.meter, list[tuple[float, FloatArray]](), list[Point]()
        known = self._posterior(0, base.problem.blur).started(scales)
        for point in self._starts(base, model, dark, known):
            cost, x = point.cost, point.x
            # A lamp in a dark room is far from soft light: its own cost ranks it, not a predicted one.
            if not dark:
                equations = point.normal_equations()
                step = damped_step(equations, _CAUTION)
                fall = float(step @ equations.gradient) + float(step @ equations.matrix @ step) / 2
                cost, x = cost + min(fall, 0.0), x + step
            ranked.append((cost, x))
            if meter.exhausted:
                break
        followed = list[Hypothesis]()
        for _, x in sorted(ranked, key=lambda pair: pair[0]):
            if len(found) == count or (found and meter.exhausted):
                break
            lamps = model.decode(x[:-EXTRA])
            if not any(_same_directions(lamps, other, _SAME_COSINE) for other in followed):
                followed.append(lamps)
                found.append(descend(point.problem.at(model, x, known), _STEPS, meter))
        return sorted(found, key=lambda point: point.cost)

    def _starts(self, base: Point, model: LightModel, dark: bool, known: Start) -> Iterator[Point]:
        """Yield starts of one lamp more beside the light that is there, or a strong one in a dark room."""
        count, coarse = base.model.lights, self._posterior(0, base.problem.blur)
        head, rows = base.x[: 3 * count], base.solution().hypothesis.rows[:, :3]
        known_model = self.scene.model(count) if dark else base.model
        tail = known_model.extend(base.x[: known_model.size], model)[3 * model.lights :]
        strength = math.log(_DARK_STRENGTH) if dark else INTENSITY.mean
        for direction in self.scene.directions:
            if count and (rows @ direction).max() > _SAME_COSINE:
                continue
            at = coarse.lattice.nearest(np.array(model.coordinates(direction)))
            x = np.array([*head, *at, strength, *tail])
            if dark:
                yield coarse.start(model, x, known)
            else:
                yield coarse.at(model, np.append(x, base.x[-EXTRA:]), known, fixed=True)

    def _settled(self, point: Point) -> Point:
        """Return the optimum near a point, with the scales that the image has there."""
        value, rise = -math.inf, math.inf
        while rise >= _FLAT:
            point = descend(point, _STEPS, self.meter).rescaled()
            before, value = value, point.log_evidence()
            rise = 0.0 if self.meter.exhausted else value - before
        return point

    def _posterior(self, size: int, blur: float) -> Posterior:
        return self.scene.posterior(self.options.sizes[size], blur)


def _same_directions(one: Hypothesis, other: Hypothesis, cosine: float) -> bool:
    """Return whether each lamp of one has a lamp of the other in a direction of such a cosine to it."""
    return bool((one.rows[:, :3] @ other.rows[:, :3].T > cosine).any(1).all())
