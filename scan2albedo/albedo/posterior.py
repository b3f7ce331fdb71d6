"""The posterior of light and albedo: log V = log albedo + log light, with a prior of every part of both."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.blas import dtrsm

from scan2albedo.albedo import node_field
from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.light_parameters import HARMONICS, LightModel, Solution
from scan2albedo.albedo.light_priors import PriorOfLight, light_prior
from scan2albedo.albedo.shadows import ShadowLattice
from scan2albedo.albedo.soft_terms import DARKEST, SoftTerms
from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.lighting.shading import FreeLamps, LitPoints, shade_with_derivatives
from scan2albedo.optimization.least_squares import Damping, LeastSquaresPoint, NormalEquations, minimize
from scan2albedo.statistics.effective_count import effective_count
from scan2albedo.statistics.robust import student_t_loss, student_t_weights

FREEDOM = 4.0
"""Degrees of freedom of Student's t of what single cells err by: hair, an outline, a mole are rare."""
FACE_MM2 = 38_500.0
"""Area of a face on the chart: scans have 35,000 to 39,000."""
CELLS_MM = 3.4
"""Correlation length of what single cells err by beside the nodes' field. The residuals of scans, two real
and two path-traced, have 2.5 to 3.1; light and albedo of path-traced faces are found best at this."""
LIGHT_MM = 6.8
"""The same of what a whole light errs by, which no single cell shows: path-traced faces err so much that two
texels in three stay below the error that is stated. A search with this length for the cells errs more (9.4 %
in place of 8.4 %)."""
TEMPER = (CELLS_MM / LIGHT_MM) ** 2
"""What the log odds of explanations are multiplied by where they are averaged [1]_, and the precision of the
light where errors are stated.

.. [1] C. Holmes, S. Walker, "Assigning a value to a power likelihood in a general Bayesian model", Biometrika
   104(2), 2017.
"""
_DARKEST_SKIN = 0.1
"""Albedo in red."""
_PALEST_SKIN = 0.8
"""The same."""
NOISE = 0.02
"""Relative noise of a cell, that of pictures of 8 bits: below this part of the median V says nothing."""
_LEAST_GRAIN = 0.1
"""Scale of grain at which cells are as noisy as rounding to 8 bits makes texels."""
_MISFIT_SD = 0.7
"""Standard deviation of the log of two scales that the image itself tells: how far this person is from the
prior, and how rough."""
_LIGHT_SD = 0.25
"""The same of light that no part stands for and of the environment's harmonics, whose usual sizes are known
better."""
_DAMPING = Damping(first=1e-2, increase=8.0, least=1e-4, after_failure=1e-3, largest=1e4)
_SETTLED = 1e-4
_State = TypeVar("_State", bound=LeastSquaresPoint)
EXTRA = 2
"""Parameters beside the light's: log scale, and how much of the faces' mean albedo this one has."""


class Posterior:
    """The cells of one `Level` with what is known of them before the light is.

        log V = log(A I + I_s),   log A = scale + likeness * mean + M u + e

    with u the `field` at the nodes, and e of single cells from Student's t of scale g s_i, g the scale of
    grain. `places` (N, 2) are those of the cells on the prior's chart, `blur` that of shadows' outlines.
    """

    def __init__(
        self,
        level: Level,
        places: FloatArray,
        lattice: ShadowLattice,
        soft: SoftTerms,
        field: node_field.NodeField,
        meter: Meter,
        blur: float = 0.0,
    ) -> None:
        self.level, self.lattice, self.soft, self.meter = level, lattice, soft, meter
        self.field, self.prior, self.places, self.blur = field, field.prior, places, blur
        self.nodes = field.weights(places)
        self.onto_nodes = self.nodes.T.tocsr()
        self.mean = self.prior.mean_at(self.places)[:, 0]
        self.value = np.log(np.maximum(level.value, node_field.FAINT))
        self.variance = (self.prior.deviation_at(self.places)[:, 0] ** 2 + NOISE**2) / cell_trust(level)
        independent = round(effective_count(FACE_MM2, CELLS_MM))
        self.repeats = max(1.0, len(self.value) / independent)
        color = np.average(level.color, axis=0, weights=level.weight)
        red, green, _ = color
        self.lead = int(np.argmax(color))
        offset, slope, self.level_sd = self.prior.level
        level_here = offset + slope * math.log(max(green, NOISE) / max(red, NOISE))
        self.log_level = float(np.clip(level_here, math.log(_DARKEST_SKIN), math.log(_PALEST_SKIN)))

    def started(self, scales: node_field.Scales, weight: FloatArray | None = None) -> Start:
        """Return `weight` (N,) of the cells, that of points far from an optimum when None, and its factor."""
        if weight is None:
            weight = 1 / (self.repeats * self.variance * scales.grain**2)
        factor = node_field.posterior_factor(self.nodes, weight, self.field.precision(scales))
        return Start(weight, scales, factor)

    def start(self, model: LightModel, x: FloatArray, known: Start) -> Point:
        """Return the point of a light x (P,), at the albedo's scale that fits best."""
        return self.at(model, np.append(x, [math.nan, 1.0]), known, fixed=True)

    def at(self, model: LightModel, x: FloatArray, known: Start, *, fixed: bool = False) -> Point:
        """Return the point at x: one counted evaluation.

        The cells are weighed once more by what they err by under `known`, or have its weights when `fixed`. A
        scale of the albedo that is NaN becomes the one that fits best.
        """
        self.meter.count()
        light_x, (scale, likeness) = np.clip(x[:-EXTRA], *model.bounds), x[-EXTRA:]
        level, found = self.level, model.decode(light_x)
        visible, visible_slope = self.lattice.visibility(model, light_x, self.blur)
        points = LitPoints(level.position, level.normal, visible, visible_slope, level.toward, level.scale)
        lamps = FreeLamps(found.rows, model.tangents(light_x), model.radius_mm, model.has("near"))
        free = {"rough": model.has("rough"), "glossy": model.has("specular")}
        (parts, highlights), slopes = shade_with_derivatives(
            points, lamps, found.reflectance, model.size, **free
        )
        light, specular = 1 + parts.sum(0), highlights.sum(0)
        self.soft.add(model, light_x, light, slopes[0])
        pattern = likeness * self.mean
        if math.isnan(scale):
            scale = np.median(self.value - np.log(np.exp(pattern) * light + specular))
        albedo = np.exp(scale + pattern)
        seen = albedo * light + specular
        diffuse = albedo * light / seen
        of_light = (albedo[:, None] * slopes[0] + slopes[1]) / seen[:, None]
        rows = np.column_stack([of_light, diffuse, diffuse * self.mean, self.value - np.log(seen)])
        x = np.concatenate([light_x, [scale, likeness]])
        nothing = np.zeros(0)
        point = Point(
            self, model, x, light, specular, parts, highlights, rows, known, nothing, nothing, known.weight
        )
        return point.settled(known, fixed)


class Start(NamedTuple):
    """Weights (N,) of the cells from a point near by, scales, and the nodes' factor for them."""

    weight: FloatArray
    scales: node_field.Scales
    factor: FloatArray


def cell_trust(level: Level) -> FloatArray:
    """Return (N,) by what the precision of each cell is multiplied: hair and half cells say less."""
    return np.clip(level.weight, 0.05, 1.0)


def robust_weights(
    error: FloatArray, variance: FloatArray, repeats: float, frequent: BoolArray | bool = False
) -> FloatArray:
    """Return (N,) the weights of Student's t of errors (N,), each of which is told `repeats` times.

    Errors of a sign that is `frequent` (N,) have the tails of one degree of freedom, Cauchy's.
    """
    square = error**2 / variance * np.where(frequent, FREEDOM, 1.0)
    return student_t_weights(square, FREEDOM) / (variance * repeats)


@dataclass(frozen=True)
class Point:
    """The posterior at x (P,) = [light, scale, likeness], on N cells and M nodes.

    `light` (N,) is I, `specular` (N,) I_s, `lamps` and `highlights` (L, N) are each lamp's parts of them.
    `rows` (N, P + 1) are the derivatives of log(A I + I_s) by x, and last what it leaves of log V. `u` (M,)
    is the nodes' best field under the weights of `known`, `error` (N,) what it leaves, and `robust` (N,) the
    weights that follow from it.
    """

    problem: Posterior
    model: LightModel
    x: FloatArray
    light: FloatArray
    specular: FloatArray
    lamps: FloatArray
    highlights: FloatArray
    rows: FloatArray
    known: Start
    u: FloatArray
    error: FloatArray
    robust: FloatArray
    shared: FloatArray | None = None
    """(M,) the field of several images of one albedo."""

    @cached_property
    def left(self) -> FloatArray:
        """(N,) log V less the log of what light and mean albedo make of it."""
        return self.rows[:, -1].copy()

    def settled(self, known: Start, fixed: bool = False) -> Point:
        """Return the same light with the nodes' field for robust weights, for those `known` when `fixed`."""
        p, variance = self.problem, self.problem.variance * known.scales.grain**2
        u, error = self._field(known)
        if fixed:
            return replace(self, known=known, u=u, error=error, robust=known.weight)
        known = p.started(known.scales, robust_weights(error, variance, p.repeats))
        u, error = self._field(known)
        robust = robust_weights(error, variance, p.repeats)
        return replace(self, known=known, u=u, error=error, robust=robust)

    def _field(self, known: Start) -> tuple[FloatArray, FloatArray]:
        """Return the nodes' best field (M,), and what it leaves of the cells (N,)."""
        p = self.problem
        u = node_field.solved(known.factor, p.onto_nodes @ (known.weight * self.left))
        return u, self.left - p.nodes @ u

    @property
    def light_x(self) -> FloatArray:
        """The light's part of x."""
        return self.x[:-EXTRA]

    @cached_property
    def prior(self) -> PriorOfLight:
        """The prior of x."""
        p, soft = self.problem, self.known.scales.soft
        return light_prior(self.model, self.x, p.log_level, p.level_sd, p.prior.face, soft)

    @cached_property
    def cost(self) -> float:
        """Minus the log of the posterior, but for constants."""
        p, scales = self.problem, self.known.scales
        misfit = student_t_loss(self.error**2 / (p.variance * scales.grain**2), FREEDOM).sum()
        far = sum(math.log(scale) ** 2 for scale in (scales.albedo, scales.grain)) / (2 * _MISFIT_SD**2)
        far += sum(math.log(scale) ** 2 for scale in (scales.light, scales.soft)) / (2 * _LIGHT_SD**2)
        sizes = p.field.log_determinant(scales) / 2 + len(self.error) / p.repeats * math.log(scales.grain)
        rough = float(p.field.own(scales) @ (self.u @ p.field.basis) ** 2) / 2
        return float(misfit) / p.repeats + rough + self.prior.cost + far + sizes

    def left_of_highlight(self) -> FloatArray:
        """Return (N,) V without the highlight, which leaves some of it."""
        value = np.exp(self.problem.value)
        return np.maximum(value - self.specular, DARKEST * value)

    def bounced(self) -> FloatArray:
        """Return (N,) the light that the surface throws onto itself."""
        soft, (_, albedo, _) = self.problem.soft, self.model.soft(self.light_x)
        if soft.bounce is None:
            return np.zeros_like(self.error)
        return albedo * soft.bounce(self.lamps.sum(0) + soft.linear(self.model, self.light_x))

    @cached_property
    def quadratic(self) -> tuple[FloatArray, FloatArray]:
        """Matrix (P, P) and gradient (P,) of the cost in x, the nodes' field following each step."""
        rows = self.rows
        weighted = rows * self.known.weight[:, None]
        nodes = dtrsm(1.0, self.known.factor, self.problem.onto_nodes @ weighted, lower=1)
        inner = rows.T @ weighted - nodes.T @ nodes
        matrix = inner[:-1, :-1] + np.diag(self.prior.curvature)
        return matrix, self.prior.slope - inner[:-1, -1]

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model with the bounds of a step."""
        (matrix, gradient), (lower, upper) = self.quadratic, self.model.bounds
        x, longest, free = self.light_x, 3 * self.model.table["step"], np.ones(EXTRA)
        least = np.concatenate([np.maximum(lower - x, -longest), -free])
        most = np.concatenate([np.minimum(upper - x, longest), free])
        return NormalEquations(matrix, gradient, least, most)

    def moved(self, step: FloatArray) -> Point:
        """Return the point at x + `step`."""
        known = self.problem.started(self.known.scales, self.robust)
        return self.problem.at(self.model, self.x + step, known)

    def rescaled(self) -> Point:
        """Return the point nearer to the scales at which the evidence is largest: one step of its iteration.

        .. [1] D. MacKay, "Bayesian interpolation", Neural Computation 4(3), 1992, section 4.
        """
        p, (albedo, light, grain, soft) = self.problem, self.known.scales
        # The evidence is largest where what the field shows is what it is free to show [1]_.
        own, along = p.field.own(self.known.scales), self.u @ p.field.basis
        left = (dtrsm(1.0, self.known.factor, p.field.basis, lower=1) ** 2).sum(0)
        free, shown = own - own**2 * left, (own * along) ** 2
        parts = list[float]()
        for scale, ratio, sd in (albedo, np.ones_like(own), _MISFIT_SD), (light, p.field.ratio, _LIGHT_SD):
            dof = scale**2 * float(ratio @ free)
            parts.append(_shrunk(scale**4 * float(ratio @ shown) / max(dof, node_field.TINY), dof, sd))
        # The variances of the cells, weighed and summed, are what the cells know of the field.
        sure = len(own) - own @ left
        rough = float(self.robust @ self.error**2 + sure) * grain**2 * p.repeats / len(self.error)
        if self.model.has("environment"):
            at = self.model.slices["environment"]
            expected = self.x[at] ** 2 + np.diag(self.covariance())[at]
            square = float((expected * self.prior.curvature[at]).mean()) * soft**2
            soft = _shrunk(square, HARMONICS, _LIGHT_SD)
        grain = max(_shrunk(rough, len(self.error) / p.repeats, _MISFIT_SD), _LEAST_GRAIN)
        scales = node_field.Scales(parts[0], parts[1], grain, soft)
        return self.settled(p.started(scales, self.robust))

    def log_evidence(self) -> float:
        """Return the log of the model's evidence by Laplace's method [1]_.

        .. [1] L. Tierney, J. Kadane, "Accurate approximations for posterior moments and marginal densities",
           JASA 81, 1986.
        """
        matrix = self.quadratic[0]
        nodes = 2 * float(np.log(np.diag(self.known.factor)).sum())
        x = float(np.linalg.slogdet(matrix)[1]) - len(matrix) * math.log(2 * math.pi)
        return -self.cost - (nodes + x) / 2

    def covariance(self) -> FloatArray:
        """Return (P, P) the covariance of x."""
        return np.asarray(np.linalg.pinv(self.quadratic[0], hermitian=True))

    def light_deviation(self) -> FloatArray:
        """Return (N,) the standard deviation of log light: of x, and of light that is not modelled."""
        p = self.problem
        light = self.known.scales.light**2 * p.field.light_covariance
        own = light @ p.field.precision(self.known.scales)
        nodes = light - own @ light + own @ node_field.inverse(self.known.factor) @ own.T
        slopes = self.rows[:, : self.model.size]
        slopes = slopes - slopes.mean(0)
        # What x changes, the nodes' part of light partly takes back.
        taken = node_field.solved(self.known.factor, p.onto_nodes @ (slopes * self.known.weight[:, None]))
        slopes = slopes - p.nodes @ (own @ taken)
        covariance = self.covariance()[:-EXTRA, :-EXTRA]
        variance = node_field.cell_variances(p.nodes, nodes)
        variance += ((slopes @ covariance) * slopes).sum(1)
        return np.sqrt(np.maximum(variance, 0.0))

    def albedo_nodes(self) -> tuple[float, FloatArray]:
        """Return a level and (M,) the nodes' log albedo beside the mean pattern, given this light.

        Light that no part stands for is a part of the median light, relative to the light found here. An
        albedo that several images share is known from all of them.
        """
        if self.shared is not None:
            return float(self.x[-EXTRA]), self.shared
        p, scales, light = self.problem, self.known.scales, self.light
        dark = scales.light * node_field.deviation_of_light(light, float(np.median(light)))
        albedo = scales.albedo**2 * p.field.albedo_covariance
        total = albedo + p.field.light_error(p.onto_nodes, dark)
        precision = cho_solve(cho_factor(total, lower=True), np.eye(len(total)))
        left = self.left + self.x[-EXTRA]
        weight = self.known.weight
        level = 0.0
        for _ in range(3):
            factor = node_field.posterior_factor(p.nodes, weight, precision)
            rows = np.column_stack([np.ones(len(left)), left])
            one, u = node_field.solved(factor, p.onto_nodes @ (rows * weight[:, None])).T
            rest = weight * (left - p.nodes @ u)
            level = float(rest.sum() / max(float((weight * (1 - p.nodes @ one)).sum()), node_field.TINY))
            u = u - level * one
            weight = robust_weights(left - level - p.nodes @ u, p.variance * scales.grain**2, p.repeats)
        return level, albedo @ (precision @ u)

    def solution(self) -> Solution:
        """Return the light as a solution."""
        return Solution(self.model, self.light_x, self.cost)


def _shrunk(square: float, count: float, deviation: float) -> float:
    """Return a scale from its mean square over so many values and the normal prior of its logarithm."""
    return math.exp(math.log(max(square, node_field.TINY**2)) / 2 * count / (count + 1 / (2 * deviation**2)))


def descend(start: _State, trials: int, meter: Meter | None) -> _State:
    """Return where damped Gauss-Newton steps lead in at most so many evaluations, or within the budget."""
    return minimize(start, trials=trials, tolerance=_SETTLED, damping=_DAMPING, meter=meter).best
