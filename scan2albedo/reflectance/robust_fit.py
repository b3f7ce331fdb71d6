"""Settings of `fit_reflectance`, and its reweighted bounded least squares of all vertices at once."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.rays import blocks, each_block
from scan2albedo.reflectance import vertex_kernels as kernels
from scan2albedo.reflectance.point_light_lobes import turn_lobes
from scan2albedo.reflectance.vertex_reflectance import BLOCK
from scan2albedo.statistics.robust import student_t_loss, student_t_weights

_WIDTH = 2.4
"""Residual over sigma from which the loss departs from squares, wider for vertices that fit worse."""
TILT_FREEDOM = 4.0
"""Degrees of freedom of the tilts' prior, Student's t: a few normals are far more wrong than most."""
_TOLERANCE = 0.02
"""A vertex is done when no number moves by more than this part of its deviation."""
_LEAST_SIGMA = np.radians(0.02)
"""Of the normals."""
_BY_VERTEX = ("observed", "precision", "lobes", "slopes", "bounce")
"""Observations with an axis of vertices, the second."""
_POWERS = {"cauchy": 1.0, "charbonnier": 0.5, "squares": 0.0}
"""Of the robust weight, see `vertex_kernels.reweigh`."""


@dataclass(frozen=True)
class ReflectanceFitOptions:
    """Settings of `fit_reflectance`; a value out of range is a `ValueError`."""

    loss: str = "cauchy"
    """One of "cauchy", "charbonnier", "squares". Of a picture's residual, its three channels together:
    outliers get little weight or none."""
    light_gains: bool = False
    """Estimate the strength of each flash in each channel, too; their mean is 1."""
    least_pairs: int = 1
    """A vertex with fewer pictures of a channel is not known."""
    most_albedo: float | None = None
    """Albedos above are impossible, and never identified; 1 where the strength of the flashes is known."""
    normal_sigma_degrees: float | str = "auto"
    """Standard deviation of the normals along each tangent, in degrees; "auto" finds it from the residuals
    and the mesh, 0 takes normals as right. Samples without slopes have no normals to tilt."""

    def __post_init__(self) -> None:
        if self.loss not in _POWERS:
            raise ValueError(f"loss is {self.loss!r}, expected one of {', '.join(_POWERS)}")
        sigma = self.normal_sigma_degrees
        if sigma != "auto" and not (isinstance(sigma, int | float) and 0 <= sigma <= 45):
            raise ValueError(f'normal_sigma_degrees is {sigma!r}, expected "auto" or a number in [0, 45]')
        if self.most_albedo is not None and not self.most_albedo > 0:
            raise ValueError(f"most_albedo is {self.most_albedo}, expected above 0")
        if self.least_pairs < 1:
            raise ValueError(f"least_pairs is {self.least_pairs}, expected >= 1")


@dataclass(frozen=True)
class Observations:
    """The observations (J, V, 3) of the vertices, with precision 1 / sigma^2, 0 where there is none.

    `lobes` is (J, V, 4); `mean` and `prior` (6,) are means and precisions of the prior. Normals are right
    when there are no `slopes` (J, V, 4); otherwise they may be tilted, by `tilt_sigma` (V,), radians, > 0.
    `bounce` (J, V, 3), or empty, is added to the diffuse lobe of each channel, and does not tilt.
    """

    observed: FloatArray
    precision: FloatArray
    lobes: FloatArray
    mean: FloatArray
    prior: FloatArray
    slopes: FloatArray | None = None
    tilt_sigma: FloatArray | None = None
    bounce: FloatArray = field(default_factory=lambda: np.empty((0, 0, 3)))

    def __post_init__(self) -> None:
        # Kernels are compiled anew for every other memory layout.
        for name in _BY_VERTEX:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))

    def of_vertices(self, rows: IntArray) -> Self:
        """Return the observations of some vertices (N,)."""
        arrays = {
            name: array for name in _BY_VERTEX if (array := getattr(self, name)) is not None and len(array)
        }
        sigma = None if self.tilt_sigma is None else self.tilt_sigma[rows]
        return replace(self, tilt_sigma=sigma, **{name: array[:, rows] for name, array in arrays.items()})


class RobustFit:
    """The reweighted least squares of all vertices; arrays are filled for those that are fitted.

    `weight` (J, V), `estimate` (V, 6), `loss` (V,), `misfit` and `tilt` (V, 2), `scale` (V,) of the residuals
    and `lobes` (J, V, 4) of the tilted normals; of the rows of `fit` only, the `normal` equations
    (N, 6, 7), `center` and `deviation` (N, 6) without bounds, the mean `tilt_variance` (N,), and `settled`.
    """

    normal: FloatArray
    center: FloatArray
    deviation: FloatArray
    tilt_variance: FloatArray
    settled: BoolArray
    iterations = 0
    residual = 0.0

    def __init__(self, data: Observations, loss: str) -> None:
        pictures, count = data.observed.shape[:2]
        self.data, self.power = data, _POWERS[loss]
        self.tilting = data.slopes is not None and data.tilt_sigma is not None
        self.lobes = data.lobes.copy() if self.tilting else data.lobes
        self.weight, self.estimate = np.ones((pictures, count)), np.zeros((count, 6))
        self.scale, self.loss, self.damping = np.full(count, np.inf), np.zeros(count), np.zeros(count)
        self.misfit, self.tilt = np.zeros((count, 2)), np.zeros((count, 2))

    def fit(self, rows: IntArray, meter: Meter) -> Self:
        """Fit the vertices `rows` (N,): least squares, then weights by residuals and tilts until none moves.

        Converged vertices are left out of further steps. The step in which the budget ends is the last.
        """
        data, size = self.data, len(rows)
        iterating = self.power > 0 or self.tilting
        observations = max((data.precision[:, rows] > 0).sum(), 1)

        def solve(block: slice) -> None:
            self._solve(rows[block])

        each_block(solve, blocks(size, BLOCK))
        self._reweigh(rows)
        moving, settled = rows, not iterating
        while True:
            meter.count()
            self.residual = float(self.loss[rows].sum() / observations)
            meter.record(self.residual)
            if settled or not len(moving) or self.iterations == 100 or meter.exhausted:
                break
            moving = moving[self._improve(moving)]
            self.iterations += 1
        self.settled = np.full(size, settled) | ~np.isin(rows, moving)
        self.normal, self.tilt_variance = np.empty((size, 6, 7)), np.zeros(size)
        self.center, self.deviation = np.empty((2, size, 6))

        def posterior(block: slice) -> None:
            part, normal, deviation = rows[block], self.normal[block], self.deviation[block]
            normal[:] = self._equations(part)
            kernels.solve_free(normal, data.mean, data.prior, self.center[block], deviation)
            if self.tilting:
                tilts, variance = self._tilt_equations(part), self.tilt_variance[block]
                kernels.deviations_with_tilts(normal, *tilts, part, deviation, variance)

        each_block(posterior, blocks(size, BLOCK))
        return self

    def _improve(self, rows: IntArray) -> BoolArray:
        """Update all of `rows` (N,) and return which moved; a step that worsens is taken back."""
        data = self.data
        before, loss, tilt = self.estimate[rows], self.loss[rows], self.tilt[rows]
        deviation = np.empty((len(rows), 6))

        def work(block: slice) -> None:
            part = rows[block]
            normal = self._solve(part)
            if not self.tilting:
                kernels.solve_free(normal, data.mean, data.prior, np.empty((len(part), 6)), deviation[block])
            else:
                tilts, unused = self._tilt_equations(part), np.empty(len(part))
                kernels.deviations_with_tilts(normal, *tilts, part, deviation[block], unused)
                kernels.step_tilts(normal, *tilts, self.damping, part, self.estimate, self.tilt)
                turn_lobes(data.lobes, data.slopes, self.tilt, part, self.lobes)

        each_block(work, blocks(len(rows), BLOCK))
        self._reweigh(rows)
        moved = np.asarray((np.abs(self.estimate[rows] - before) > _TOLERANCE * deviation).any(1))
        if self.tilting:
            worse = self.loss[rows] > loss * (1 + 1e-12)
            damping = self.damping[rows]
            self.damping[rows] = np.where(worse, np.maximum(10 * damping, 0.1), damping / 10)
            back = rows[worse]
            self.estimate[back], self.tilt[back] = before[worse], tilt[worse]
            turn_lobes(data.lobes, data.slopes, self.tilt, back, self.lobes)
            self._reweigh(back)
            moved |= worse & (self.damping[rows] < 1e6)  # with more, steps are of no use
        return moved

    def _equations(self, part: IntArray) -> FloatArray:
        normal = np.empty((len(part), 6, 7))
        data = self.data
        seen = data.observed, data.precision, self.lobes, data.bounce, self.weight
        kernels.add_normal_equations(*seen, part, normal)
        return normal

    def _solve(self, part: IntArray) -> FloatArray:
        """Find the bounded estimates of `part` (N,), and return their equations (N, 6, 7)."""
        normal, found = self._equations(part), np.empty((len(part), 6))
        kernels.solve_bounded(normal, self.data.mean, self.data.prior, found)
        self.estimate[part] = found
        return normal

    def _tilt_equations(self, part: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return equations (N, 2, 9), the prior (6,), and that of tilts (V,): a Gaussian that touches it."""
        equations, data = np.empty((len(part), 2, 9)), self.data
        assert data.tilt_sigma is not None
        seen = self.lobes, data.bounce, data.slopes, self.weight, self.estimate, self.tilt
        kernels.add_tilt_equations(data.observed, data.precision, *seen, part, equations)
        square = (self.tilt**2).sum(1) / data.tilt_sigma**2
        return equations, data.prior, student_t_weights(square, TILT_FREEDOM, 2) / data.tilt_sigma**2

    def _reweigh(self, rows: IntArray) -> None:
        """Update weights, losses and misfits of `rows` (N,)."""

        def work(block: slice) -> None:
            data = self.data
            seen = data.observed, data.precision, self.lobes, data.bounce, self.estimate
            filled = self.scale, self.weight, self.loss, self.misfit
            kernels.reweigh(*seen, data.mean, data.prior, rows[block], self.power, _WIDTH, *filled)

        each_block(work, blocks(len(rows), BLOCK))
        if self.tilting:
            assert self.data.tilt_sigma is not None
            square = (self.tilt[rows] ** 2).sum(1) / self.data.tilt_sigma[rows] ** 2
            self.loss[rows] += student_t_loss(square, TILT_FREEDOM, 2)


def normal_sigma(
    data: Observations,
    spread: FloatArray | None,
    rows: IntArray,
    options: ReflectanceFitOptions,
    meter: Meter,
) -> FloatArray:
    """Return the standard deviation (V,) of the normals along each tangent, radians.

    Tilts t of a thousand vertices, with variances C, are found under a broad prior. The deviation follows
    s^2 = a + b spread^2, a and b >= 0, with the `spread` (V,) of the triangles' normals around each vertex
    (radians; none is a alone), by maximum likelihood: scoring of t.t / 2 - C, with weights of Student's t.
    """
    from scipy.optimize import nnls

    degrees = options.normal_sigma_degrees
    count = data.observed.shape[1]
    if not isinstance(degrees, str):
        return np.full(count, np.radians(degrees))
    few = rows[:: max(1, len(rows) // 1000)]
    part = replace(data.of_vertices(few), tilt_sigma=np.full(len(few), np.radians(10)))
    fitted = RobustFit(part, options.loss).fit(np.arange(len(few)), meter.untraced())
    meter.count()
    wide = np.zeros(count) if spread is None else np.minimum(spread, 1.0) ** 2
    terms = np.stack([np.ones(len(few)), wide[few]], 1)
    misfit = fitted.misfit[:, 0] / np.maximum(fitted.misfit[:, 1] - 8, 1.0)
    noise = fitted.tilt_variance * np.fmax(misfit, 1.0)
    square, found = (fitted.tilt**2).sum(1), np.array([np.radians(1) ** 2, 0.0])
    for _ in range(30):
        total = np.maximum(terms @ found, _LEAST_SIGMA**2) + noise
        robust = student_t_weights(square / total, TILT_FREEDOM, 2)
        before, found = found, nnls(terms / total[:, None], (robust * square / 2 - noise) / total)[0]
        if np.abs(found - before).max() <= 1e-3 * before.max():
            break
    return np.sqrt(np.maximum(np.stack([np.ones(count), wide], 1) @ found, _LEAST_SIGMA**2))
