"""The posterior of light and albedo: log V = log albedo + log light, with a prior of every part of both."""

from __future__ import annotations

import copy
import math
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.blas import dtrsm

from scan2albedo.albedo import node_field
from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.light_parameters import HARMONICS, LightModel, Solution
from scan2albedo.albedo.light_priors import light_prior
from scan2albedo.albedo.shadows import ShadowLattice
from scan2albedo.albedo.soft_terms import DARKEST, SoftTerms
from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.lighting.shading import FreeLamps, LitPoints, log_rows, shade_with_derivatives
from scan2albedo.optimization.least_squares import Damping, LeastSquaresPoint, NormalEquations, minimize

FREEDOM = 4.0
"""Degrees of freedom of Student's t of what single cells err by [1]_: hair, an outline, a mole are rare.

.. [1] K. Lange, R. Little, J. Taylor, "Robust statistical modeling using the t distribution", JASA 84, 1989.
"""
_INDEPENDENT = 530.0
"""Cells of a whole chart that err independently. It has some 1,250 at 1/40 of its side; on path-traced faces
that were left out light is found best where two or three count as one: what fits and lamps err by correlates
farther than texture does."""
TEMPER = 0.25
"""What the log odds of explanations are multiplied by where they are averaged [1]_, and the precision of the
light where errors are told: texels of faces that were left out err some two times as much as the posterior
says, as if four cells were one.

.. [1] C. Holmes, S. Walker, "Assigning a value to a power likelihood in a general Bayesian model", Biometrika
   104(2), 2017.
"""
_ALBEDOS = 0.1, 0.8
"""Of skin, dark and pale, in red."""
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
        self.repeats = max(1.0, len(self.value) / _INDEPENDENT)
        color = np.average(level.color, axis=0, weights=level.weight)
        self.lead, (red, green, _) = int(np.argmax(color)), color
        offset, slope, self.level_sd = self.prior.level
        level_here = offset + slope * math.log(max(green, NOISE) / max(red, NOISE))
        self.log_level = float(np.clip(level_here, *np.log(_ALBEDOS)))

    def started(self, scales: node_field.Scales, weight: FloatArray | None = None) -> Start:
        """Return `weight` (N,) of the cells, that of points far from an optimum when None, and its factor."""
        if weight is None:
            weight = 1 / (self.repeats * self.variance * scales.grain**2)
        factor = node_field.posterior_factor(self.nodes, weight, self.field.precision(scales))
        return Start(weight, scales, factor)

    def start(self, model: LightModel, x: FloatArray, known: Start) -> Point:
        """Return the point of a light x (P,), at the albedo's scale that fits best."""
        return Point(self, model, np.append(x, [math.nan, 1.0]), known, fixed=True)


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
    return (FREEDOM + 1) / (FREEDOM + square) / (variance * repeats)


class Point:
    """The posterior at x = [light, scale, likeness]: one counted evaluation. NaN is the scale that fits best.

    The cells are weighed once more by what they err by under `known`, or have its weights when `fixed`.
    `u` (M,) is the nodes' best field, `shared` (M,) that of several images of one albedo.
    """

    shared: FloatArray | None = None

    def __init__(
        self, problem: Posterior, model: LightModel, x: FloatArray, known: Start, *, fixed: bool = False
    ) -> None:
        problem.meter.count()
        self.problem, self.model = problem, model
        lower, upper = model.bounds
        self.x = np.concatenate([np.clip(x[:-EXTRA], lower, upper), x[-EXTRA:]])
        p, light_x = problem, self.light_x
        level, found, cells = p.level, model.decode(light_x), len(p.value)
        visible, visible_slope = p.lattice.visibility(model, light_x, p.blur)
        points = LitPoints(level.position, level.normal, visible, visible_slope, level.toward, level.scale)
        lamps = FreeLamps(found.rows, model.tangents(light_x), model.radius_mm, model.has("near"))
        free = {"rough": model.has("rough"), "glossy": model.has("specular")}
        light, specular, slopes = shade_with_derivatives(points, lamps, found.reflectance, model.size, **free)
        self.lamps, self.highlights = slopes[..., 2 : 3 * model.lights : 3].transpose(0, 2, 1).copy()
        p.soft.add(model, light_x, light, slopes[0])
        self.light, self.specular = light, specular
        if math.isnan(self.x[-EXTRA]):
            self.x[-EXTRA] = np.median(p.value - np.log(np.exp(self.x[-1] * p.mean) * light + specular))
        self.rows = np.empty((cells, model.size + EXTRA + 1))
        log_rows(p.value, p.mean, light, specular, *slopes, *self.x[-EXTRA:], self.rows)
        self.left = self.rows[:, -1].copy()
        self._settle(known, fixed)

    def _settle(self, known: Start, fixed: bool) -> None:
        """Estimate the nodes' field for robust weights; the cost follows."""
        self._quadratic: tuple[FloatArray, FloatArray] | None = None
        self.robust: FloatArray
        p, (albedo, light, grain, soft) = self.problem, known.scales
        variance, free = p.variance * grain**2, FREEDOM
        for again in range(1 if fixed else 2):
            self.known = p.started(known.scales, self.robust) if again else known
            self.u = node_field.solved(self.known.factor, p.onto_nodes @ (self.known.weight * self.left))
            self.error = self.left - p.nodes @ self.u
            self.robust = known.weight if fixed else robust_weights(self.error, variance, p.repeats)
        misfit = (free + 1) / 2 * np.log1p(self.error**2 / (free * variance)).sum()
        self.prior = light_prior(self.model, self.x, p.log_level, p.level_sd, p.prior.face, soft)
        far = sum(math.log(scale) ** 2 for scale in (albedo, grain)) / (2 * _MISFIT_SD**2)
        far += sum(math.log(scale) ** 2 for scale in (light, soft)) / (2 * _LIGHT_SD**2)
        sizes = p.field.log_determinant(known.scales) / 2 + len(self.error) / p.repeats * math.log(grain)
        rough = float(p.field.own(known.scales) @ (self.u @ p.field.basis) ** 2) / 2
        self.cost = float(misfit) / p.repeats + rough + self.prior.cost + far + sizes

    @property
    def light_x(self) -> FloatArray:
        """The light's part of x."""
        return self.x[:-EXTRA]

    def left_of_highlight(self) -> FloatArray:
        """Return (N,) V without the highlight, which leaves some of it."""
        value = np.exp(self.problem.value)
        return np.maximum(value - self.specular, DARKEST * value)

    def bounced(self) -> FloatArray:
        """Return (N,) the light that the surface throws onto itself."""
        soft, (_, albedo, waves) = self.problem.soft, self.model.soft(self.light_x)
        if soft.bounce is None:
            return np.zeros(len(self.light))
        return albedo * soft.bounce(self.lamps.sum(0) + soft.transfer[:, 1:] @ waves)

    def quadratic(self) -> tuple[FloatArray, FloatArray]:
        """Return matrix (P, P) and gradient (P,) of the cost in x, the nodes' field following each step."""
        if self._quadratic is None:
            weighted = self.rows * self.known.weight[:, None]
            nodes = dtrsm(1.0, self.known.factor, self.problem.onto_nodes @ weighted, lower=1)
            inner = self.rows.T @ weighted - nodes.T @ nodes
            matrix = inner[:-1, :-1] + np.diag(self.prior.curvature)
            self._quadratic = matrix, self.prior.slope - inner[:-1, -1]
        return self._quadratic

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model with the bounds of a step."""
        (matrix, gradient), (lower, upper) = self.quadratic(), self.model.bounds
        x, longest, free = self.light_x, 3 * self.model.steps(), np.ones(EXTRA)
        least = np.concatenate([np.maximum(lower - x, -longest), -free])
        most = np.concatenate([np.minimum(upper - x, longest), free])
        return NormalEquations(matrix, gradient, least, most)

    def moved(self, step: FloatArray) -> Point:
        """Return the point at x + `step`."""
        known = self.problem.started(self.known.scales, self.robust)
        return Point(self.problem, self.model, self.x + step, known)

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
        if self.model.environment:
            at = slice(first := self.model.position_of("environment"), first + HARMONICS)
            expected = self.x[at] ** 2 + np.diag(self.covariance())[at]
            square = float((expected * self.prior.curvature[at]).mean()) * soft**2
            soft = _shrunk(square, HARMONICS, _LIGHT_SD)
        other = copy.copy(self)
        grain = max(_shrunk(rough, len(self.error) / p.repeats, _MISFIT_SD), _LEAST_GRAIN)
        other._settle(p.started(node_field.Scales(parts[0], parts[1], grain, soft), self.robust), False)
        return other

    def log_evidence(self) -> float:
        """Return the log of the model's evidence by Laplace's method [1]_.

        .. [1] L. Tierney, J. Kadane, "Accurate approximations for posterior moments and marginal densities",
           JASA 81, 1986.
        """
        matrix = self.quadratic()[0]
        nodes = 2 * float(np.log(np.diag(self.known.factor)).sum())
        x = float(np.linalg.slogdet(matrix)[1]) - len(matrix) * math.log(2 * math.pi)
        return -self.cost - (nodes + x) / 2

    def covariance(self) -> FloatArray:
        """Return (P, P) the covariance of x."""
        return np.asarray(np.linalg.pinv(self.quadratic()[0], hermitian=True))

    def light_deviation(self) -> FloatArray:
        """Return (N,) the standard deviation of log light: of x, and of light that is not modelled."""
        p = self.problem
        light = self.known.scales.light**2 * p.field.light_covariance
        own = light @ p.field.precision(self.known.scales)
        nodes = light - own @ light + own @ node_field.inverse(self.known.factor) @ own.T
        slopes = self.rows[:, : self.model.size] - self.rows[:, : self.model.size].mean(0)
        # What x changes, the nodes' part of light partly takes back.
        taken = node_field.solved(self.known.factor, p.onto_nodes @ (slopes * self.known.weight[:, None]))
        slopes = slopes - p.nodes @ (own @ taken)
        covariance = self.covariance()[:-EXTRA, :-EXTRA]
        variance = node_field.cell_variances(p.nodes.indptr, p.nodes.indices, p.nodes.data, nodes)
        variance += ((slopes @ covariance) * slopes).sum(1)
        return np.sqrt(np.maximum(variance, 0.0))

    def albedo_nodes(self) -> tuple[float, FloatArray]:
        """Return a level and (M,) the nodes' log albedo beside the mean pattern, given this light.

        Light that no part stands for is a part of the median light, relative to the light found here. An
        albedo that several images share is known from all of them.
        """
        if self.shared is not None:
            return float(self.x[-EXTRA]), self.shared
        p, scales = self.problem, self.known.scales
        dark = scales.light * node_field.deviation_of_light(self.light, float(np.median(self.light)))
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
