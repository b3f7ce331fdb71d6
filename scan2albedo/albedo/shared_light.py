"""The lights of several images of one albedo: one posterior of all of them, the albedo shared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.linalg.blas import dtrsm

from scan2albedo.albedo import node_field
from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.posterior import EXTRA, FREEDOM, NOISE, Point, cell_trust, descend, robust_weights
from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.optimization.least_squares import NormalEquations


class SharedLight:
    """K lights of one albedo at once, on the C cells of a chart.

        log V_k = log(A I_k + I_sk) + f_k + e_k,   log A = scale_k + likeness * mean + M u + a

    with the prior of A of a `Posterior`, shared by all images, and what each of them errs by alone: light f_k
    that no part stands for, and noise e_k of Student's t, whose `noise` all images tell together and whose
    tails are heavier toward the dark: shadows that no ray finds. What moves with the light is light, what
    stays is albedo. `points` are the images' own, at one likeness.
    """

    def __init__(
        self,
        points: Sequence[Point],
        cells: Sequence[IntArray],
        prior: tuple[sparse.csr_matrix, FloatArray, node_field.Scales],
        noise: float = 2 * NOISE,
        weights: Sequence[FloatArray] | None = None,
    ) -> None:
        self.points, self.cells, self.prior, self.noise = points, cells, prior, noise
        (self.nodes, self.precision, scales), first = prior, points[0].problem
        self.repeats = max(point.problem.repeats for point in points)
        self.own = np.empty(self.nodes.shape[0])
        for point, cell in zip(points, cells, strict=True):
            deviation = first.prior.deviation_at(point.problem.places, slice(1))[:, 0]
            self.own[cell] = self.repeats * (scales.grain * deviation) ** 2
        dark = [
            point.known.scales.light
            * node_field.deviation_of_light(point.light, float(np.median(point.light)))
            for point in points
        ]
        self.variance = [
            (noise**2 + light**2) / cell_trust(point.problem.level)
            for point, light in zip(points, dark, strict=True)
        ]
        self._settle([1 / (self.repeats * v) for v in self.variance] if weights is None else weights)

    def _settle(self, weights: Sequence[FloatArray]) -> None:
        """Estimate the albedo for robust weights; the cost follows."""
        onto, repeats = self.nodes.T, self.repeats
        for _ in range(2):
            self.weights, (known, top) = weights, np.zeros((2, len(self.own)))
            for point, cell, weight in zip(self.points, self.cells, weights, strict=True):
                known[cell] += weight
                top[cell] += weight * point.left
            share = 1 / (1 + known * self.own)
            self.factor = node_field.posterior_factor(self.nodes, known * share, self.precision)
            self.u = node_field.solved(self.factor, onto @ (top * share))
            self.total, smooth = known + 1 / self.own, self.nodes @ self.u
            detail = (top - known * smooth) / self.total
            self.error = [p.left - (smooth + detail)[c] for p, c in zip(self.points, self.cells, strict=True)]
            pairs = list(zip(self.error, self.variance, strict=True))
            weights = [robust_weights(e, v, repeats, e < 0) for e, v in pairs]
        misfit = 0.0
        free = FREEDOM
        for e, v in pairs:
            tail = np.where(e < 0, free, 1.0)
            misfit += float(((free + 1) / tail * np.log1p(tail * e**2 / (free * v)) + np.log(v)).sum())
        rough = float(self.u @ self.precision @ self.u) + float((detail**2 / self.own).sum())
        self.cost = (misfit / repeats + rough) / 2 + sum(point.prior.cost for point in self.points)

    @cached_property
    def _equations(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Matrix (P, P) and gradient (P,) of all x for a known smooth albedo, and what u adds (M, P)."""
        rows = [point.rows[:, :-EXTRA] for point in self.points]
        blocks, gradients, onto_cells = list[FloatArray](), list[FloatArray](), list[FloatArray]()
        each = zip(self.points, self.cells, rows, self.weights, self.error, strict=True)
        for point, cell, row, weight, error in each:
            weighted, free = row * weight[:, None], slice(row.shape[1])
            blocks.append(row.T @ weighted + np.diag(point.prior.curvature[free]))
            gradients.append(point.prior.slope[free] - weighted.T @ error)
            onto_cells.append(np.zeros((len(self.own), row.shape[1])))
            onto_cells[-1][cell] = weighted
        joined = np.hstack(onto_cells)
        matrix = block_diag(*blocks) - (joined / self.total[:, None]).T @ joined
        along = self.nodes.T @ (joined / (self.own * self.total)[:, None])
        return matrix, np.concatenate(gradients), along

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model of all lights and scales, the albedo following each step."""
        matrix, gradient, along = self._equations
        nodes = dtrsm(1.0, self.factor, along, lower=1)
        least, most = list[FloatArray](), list[FloatArray]()
        for point in self.points:
            lower, upper = point.model.bounds
            longest = 3 * point.model.table["step"]
            least += [np.maximum(lower - point.light_x, -longest), -np.ones(1)]
            most += [np.minimum(upper - point.light_x, longest), np.ones(1)]
        matrix = matrix - nodes.T @ nodes
        return NormalEquations(matrix, gradient, np.concatenate(least), np.concatenate(most))

    def moved(self, step: FloatArray) -> SharedLight:
        """Return the lights after a step."""
        points = list[Point]()
        first = 0
        for point in self.points:
            size = point.model.size + 1
            x = point.x + np.append(step[first : first + size], 0.0)
            points.append(point.problem.at(point.model, x, point.known, fixed=True))
            first += size
        return SharedLight(points, self.cells, self.prior, self.noise, self.weights)

    def rescaled(self) -> SharedLight:
        """Return the same with the noise that the images have: by what they differ where all are well lit."""
        pairs = list(zip(self.weights, self.error, self.variance, strict=True))
        square = sum(float((self.repeats * weight * error**2).sum()) for weight, error, _ in pairs)
        count = sum(len(error) for error in self.error)
        free = count - float((1 - 1 / (self.own * self.total)).sum())
        noise = self.noise * math.sqrt(square / max(free, 1.0))
        return SharedLight(self.points, self.cells, self.prior, noise, self.weights)

    def deviation(self) -> FloatArray:
        """Return (C,) the standard deviation of the log of the smooth albedo, best scale removed."""
        matrix, _, along = self._equations
        lights = along @ np.linalg.pinv(matrix, hermitian=True) @ along.T
        precision = np.tril(self.factor) @ np.tril(self.factor).T
        left = cho_solve(cho_factor(precision - lights, lower=True), np.eye(len(precision)))
        mean = np.asarray(self.nodes.sum(0)).ravel() / len(self.own)
        turned = np.eye(len(mean)) - mean
        covariance = turned @ left @ turned.T
        variance = node_field.cell_variances(self.nodes, covariance)
        return np.sqrt(np.maximum(variance, 0.0))


@dataclass(frozen=True)
class SharedLights:
    """The lights of K images of one albedo, and how well they tell it."""

    points: list[Point]
    """Of each image."""
    deviation: tuple[Level, FloatArray]
    """The C cells that any image has, and the standard deviation (C,) of the log of their albedo."""


def shared_lights(points: Sequence[Point], width: int, meter: Meter) -> SharedLights:
    """Return the lights of images of one albedo from their own optima; `width` is that of the chart."""
    first = points[0].problem
    level, prior = first.level, first.prior
    across = -(-width // level.factor)
    numbers = [point.problem.level.cell @ (across, 1) for point in points]
    every = np.unique(np.concatenate(numbers))
    cells = [np.searchsorted(every, number) for number in numbers]
    places = np.empty((len(every), 2))
    for point, cell in zip(points, cells, strict=True):
        places[cell] = point.problem.places
    weights = prior.node_weights(places)
    used = np.flatnonzero(np.asarray(weights.sum(0)).ravel() > 0)
    logs = np.mean([np.log(point.known.scales) for point in points], 0)
    scales = node_field.Scales(*np.exp(logs))
    likeness = float(np.mean([point.x[-1] for point in points]))
    covariance = scales.albedo**2 * prior.covariance(0)[np.ix_(used, used)]
    precision = node_field.inverse(np.asarray(np.linalg.cholesky(covariance), float))
    starts = [p.problem.at(p.model, np.append(p.x[:-1], likeness), p.known, fixed=True) for p in points]
    shared = SharedLight(starts, cells, (weights[:, used].tocsr(), precision, scales))
    for _ in range(3):
        shared = descend(shared, 10, meter).rescaled()
    albedos = [shared.u[np.searchsorted(used, point.problem.field.used)] for point in shared.points]
    found = [replace(point, shared=u) for point, u in zip(shared.points, albedos, strict=True)]
    at = replace(level, cell=np.stack(np.divmod(every, across), 1))
    return SharedLights(found, (at, shared.deviation()))
