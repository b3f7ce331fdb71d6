"""Settings of `fit_reflectance`, and its reweighted bounded least squares of all vertices at once."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.rays import blocks, each_block
from scan2albedo.reflectance import tilt_kernels
from scan2albedo.reflectance import vertex_kernels as kernels

_BLOCK = 128
"""Vertices whose normal equations fit the first cache."""
_WIDTH = 2.4
"""Residual over sigma from which the loss departs from squares; wider for vertices that fit worse."""
_ITERATIONS, _TOLERANCE = 100, 0.02
"""Most reweightings; a vertex is done when no number moves by more than this part of its deviation."""
TILT_FREEDOM = 4.0
"""Degrees of freedom of the tilts' prior, Student's t: a few normals are far more wrong than most."""
_MOST_DAMPING = 1e6
_KINDS = {"cauchy": kernels.CAUCHY, "charbonnier": kernels.CHARBONNIER, "squares": kernels.NONE}


@dataclass(frozen=True)
class ReflectancePrior:
    """Gaussian prior of a vertex before its pictures, in units of `level`.

    It keeps lobes that no picture shows from fitting noise. A value out of range is a `ValueError`.
    """

    diffuse_mean: float = 1.0
    diffuse_std: float = 1.0
    """`diffuse_mean`, `diffuse_std`: of each channel's albedo; as wide as its level."""
    weights_mean: tuple[float, float, float] = (0.1, 0.1, 0.1)
    weights_std: tuple[float, float, float] = (0.3, 0.3, 0.3)
    """`weights_mean`, `weights_std`: of the lobes with exponents 1, 8 and 64."""
    level: float | None = None
    """Unit of the others; None takes the median of the albedos without highlights, since the strength of the
    flash and the albedo cannot be separated."""

    def __post_init__(self) -> None:
        if len(self.weights_mean) != 3 or len(self.weights_std) != 3:
            raise ValueError("weights_mean and weights_std must have three numbers each")
        means = (self.diffuse_mean, *self.weights_mean)
        if not all(0 <= value < math.inf for value in means):
            raise ValueError(f"diffuse_mean and weights_mean must be finite and >= 0, got {means}")
        stds = (self.diffuse_std, *self.weights_std)
        if not all(0 < value < math.inf for value in stds):
            raise ValueError(f"diffuse_std and weights_std must be finite and > 0, got {stds}")
        if self.level is not None and not 0 < self.level < math.inf:
            raise ValueError(f"level is {self.level}, expected > 0 and finite")


@dataclass(frozen=True)
class ReflectanceFitOptions:
    """Settings of `fit_reflectance`; a value out of range is a `ValueError`."""

    prior: ReflectancePrior = ReflectancePrior()
    """Of every vertex."""
    loss: str = "cauchy"
    """One of "cauchy", "charbonnier", "squares". Of a picture's residual, its three channels together:
    outliers, such as a shadow that the mesh does not cast, get little weight or none."""
    light_gains: bool = False
    """Estimate the strength of each flash in each channel, too; their mean is 1."""
    gain_iterations: int = 50
    gain_vertices: int = 2000
    gain_tolerance: float = 1e-5
    """`gain_iterations`, `gain_vertices`, `gain_tolerance`: most alternations, vertices (evenly chosen) that
    gains are found from, and change that ends them."""
    least_pairs: int = 1
    """A vertex with fewer pictures of a channel is not known."""
    most_albedo: float | None = None
    """Albedos above are impossible, and never identified; 1 where the strength of the flashes is known."""
    normal_sigma_degrees: float | str = "auto"
    """Standard deviation of the normals along each tangent, in degrees; "auto" finds it from the residuals
    and the mesh, 0 takes normals as right. Samples without slopes have no normals to tilt."""

    def __post_init__(self) -> None:
        if self.loss not in _KINDS:
            raise ValueError(f"loss is {self.loss!r}, expected one of {', '.join(_KINDS)}")
        sigma = self.normal_sigma_degrees
        if sigma != "auto" and not (isinstance(sigma, int | float) and 0 <= sigma <= 45):
            raise ValueError(f'normal_sigma_degrees is {sigma!r}, expected "auto" or a number in [0, 45]')
        if self.most_albedo is not None and not self.most_albedo > 0:
            raise ValueError(f"most_albedo is {self.most_albedo}, expected above 0")
        if not 0 < self.gain_tolerance < math.inf:
            raise ValueError(f"gain_tolerance is {self.gain_tolerance}, expected > 0 and finite")
        for name in ("gain_iterations", "gain_vertices", "least_pairs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected >= 1")


@dataclass(frozen=True)
class Observations:
    """The observations (J, V, 3) of the vertices, with precision 1 / sigma^2, 0 where there is none.

    `lobes` is (J, V, 4); `mean` and `prior` (6,) are means and precisions of the prior. Normals are right
    when there are no `slopes` (J, V, 4); otherwise they may be tilted, by `tilt_sigma` (V,), radians, > 0.
    """

    observed: FloatArray
    precision: FloatArray
    lobes: FloatArray
    mean: FloatArray
    prior: FloatArray
    slopes: FloatArray | None = None
    tilt_sigma: FloatArray | None = None

    def __post_init__(self) -> None:
        # Kernels are compiled anew for every other memory layout.
        for name in ("observed", "precision", "lobes", "slopes"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))

    def of_vertices(self, rows: IntArray) -> Observations:
        """Return the observations of some vertices (N,)."""
        return replace(
            self,
            observed=self.observed[:, rows],
            precision=self.precision[:, rows],
            lobes=self.lobes[:, rows],
            slopes=None if self.slopes is None else self.slopes[:, rows],
            tilt_sigma=None if self.tilt_sigma is None else self.tilt_sigma[rows],
        )


@dataclass(frozen=True)
class RobustFit:
    """Results for the vertices `rows` (N,), filled by the kernels of `vertex_kernels`; weight (J, N).

    `tilt` (N, 2) and `tilt_variance` (N,), the mean of its two, are 0 where normals are right.
    """

    estimate: FloatArray
    center: FloatArray
    deviation: FloatArray
    normal: FloatArray
    misfit: FloatArray
    weight: FloatArray
    settled: BoolArray
    bounded_albedos: int
    iterations: int
    residual: float
    tilt: FloatArray
    tilt_variance: FloatArray


def fit_rows(data: Observations, rows: IntArray, options: ReflectanceFitOptions, meter: Meter) -> RobustFit:
    """Fit the vertices `rows` (N,): least squares, then weights by residuals and tilts until none moves.

    Converged vertices are left out of further steps. The step in which the budget ends is the last.
    """
    state = _State.start(data, options.loss)
    iterating = options.loss != "squares" or state.tilting
    observations = max(int((data.precision[:, rows] > 0).sum()), 1)

    def count() -> None:
        meter.count()
        meter.record(state.loss[rows].sum() / observations)

    state.solve(data, rows)
    state.reweigh(data, rows)
    count()
    moving, iterations = rows, 0
    while iterating and len(moving) and iterations < _ITERATIONS and not meter.exhausted:
        moved = state.improve(data, moving)
        count()
        iterations += 1
        moving = moving[moved]
    center, deviation, tilt_variance = (np.empty((len(rows), n)) for n in (6, 6, 1))
    normal = np.empty((len(rows), 3, 14))
    state.posterior(data, rows, normal, center, deviation, tilt_variance[:, 0])
    estimate = state.estimate[rows]
    settled = ~np.isin(rows, moving) if iterating else np.ones(len(rows), bool)
    return RobustFit(
        estimate,
        center,
        deviation,
        normal,
        state.misfit[rows],
        state.weight[:, rows],
        settled,
        int((estimate[:, :3] == 0).any(1).sum()),
        iterations,
        float(state.loss[rows].sum() / observations),
        state.tilt[rows],
        tilt_variance[:, 0],
    )


@dataclass(frozen=True)
class _State:
    """weight (J, V), estimate (V, 6), scale and loss (V,), misfit and tilt (V, 2); filled in place.

    `lobes` (J, V, 4) are those of the tilted normals; `damping` (V,) shortens the steps of the tilts.
    """

    loss_kind: int
    tilting: bool
    lobes: FloatArray
    weight: FloatArray
    estimate: FloatArray
    scale: FloatArray
    loss: FloatArray
    misfit: FloatArray
    tilt: FloatArray
    damping: FloatArray

    @classmethod
    def start(cls, data: Observations, loss: str) -> _State:
        """Return the state of least squares, before any estimate."""
        pictures, count = data.observed.shape[:2]
        tilting = data.slopes is not None and data.tilt_sigma is not None
        return cls(
            _KINDS[loss],
            tilting,
            data.lobes.copy() if tilting else data.lobes,
            np.ones((pictures, count)),
            np.zeros((count, 6)),
            np.full(count, np.inf),
            np.zeros(count),
            np.zeros((count, 2)),
            np.zeros((count, 2)),
            np.zeros(count),
        )

    def solve(self, data: Observations, rows: IntArray) -> None:
        """Update the estimate of `rows` (N,) for the tilts as they are."""

        def work(block: slice) -> None:
            part = rows[block]
            found = np.empty((len(part), 6))
            kernels.solve_bounded(self._normal(data, part), data.mean, data.prior, found)
            self.estimate[part] = found

        each_block(work, blocks(len(rows), _BLOCK))

    def improve(self, data: Observations, rows: IntArray) -> BoolArray:
        """Update all of `rows` (N,) and return which moved; a step that worsens is taken back."""
        before, loss, tilt = self.estimate[rows], self.loss[rows], self.tilt[rows]
        deviation = np.empty((len(rows), 6))

        def work(block: slice) -> None:
            part = rows[block]
            normal, found, center = (
                self._normal(data, part),
                np.empty((len(part), 6)),
                np.empty((len(part), 6)),
            )
            kernels.solve_bounded(normal, data.mean, data.prior, found)
            kernels.solve_free(normal, data.mean, data.prior, center, deviation[block])
            self.estimate[part] = found
            if self.tilting:
                self._step_tilts(data, part, normal, deviation[block])

        each_block(work, blocks(len(rows), _BLOCK))
        self.reweigh(data, rows)
        moved = np.asarray((np.abs(self.estimate[rows] - before) > _TOLERANCE * deviation).any(1))
        if self.tilting:
            worse = self.loss[rows] > loss * (1 + 1e-12)
            self.damping[rows] = np.where(
                worse, np.maximum(10 * self.damping[rows], 0.1), 0.1 * self.damping[rows]
            )
            back = rows[worse]
            self.estimate[back], self.tilt[back] = before[worse], tilt[worse]
            self._turn(data, back)
            self.reweigh(data, back)
            moved |= worse & (self.damping[rows] < _MOST_DAMPING)
        return moved

    def _normal(self, data: Observations, part: IntArray) -> FloatArray:
        normal = np.empty((len(part), 3, 14))
        kernels.add_normal_equations(data.observed, data.precision, self.lobes, self.weight, part, normal)
        return normal

    def _tilt_prior(self, data: Observations) -> FloatArray:
        """Return (V,) the precisions of the Gaussian that touches the tilts' prior."""
        assert data.tilt_sigma is not None
        return np.asarray((TILT_FREEDOM + 2) / (TILT_FREEDOM * data.tilt_sigma**2 + (self.tilt**2).sum(1)))

    def _tilt_equations(self, data: Observations, part: IntArray) -> FloatArray:
        equations = np.empty((len(part), tilt_kernels.TILT_EQUATIONS))
        tilt_kernels.add_tilt_equations(
            data.observed,
            data.precision,
            self.lobes,
            data.slopes,
            self.weight,
            self.estimate,
            self.tilt,
            part,
            equations,
        )
        return equations

    def _step_tilts(
        self, data: Observations, part: IntArray, normal: FloatArray, deviation: FloatArray
    ) -> None:
        equations, prior = self._tilt_equations(data, part), self._tilt_prior(data)
        tilt_kernels.deviations_with_tilts(
            normal, equations, data.prior, prior, part, deviation, np.empty(len(part))
        )
        tilt_kernels.step_tilts(
            normal, equations, data.prior, prior, self.damping, part, self.estimate, self.tilt
        )
        self._turn(data, part)

    def _turn(self, data: Observations, rows: IntArray) -> None:
        tilt_kernels.turn_lobes(data.lobes, data.slopes, self.tilt, rows, self.lobes)

    def posterior(
        self,
        data: Observations,
        rows: IntArray,
        normal: FloatArray,
        center: FloatArray,
        deviation: FloatArray,
        tilt_variance: FloatArray,
    ) -> None:
        """Fill normal equations (N, 3, 14), means and standard deviations (N, 6) without bounds."""
        tilt_variance[:] = 0.0

        def work(block: slice) -> None:
            part = rows[block]
            normal[block] = self._normal(data, part)
            kernels.solve_free(normal[block], data.mean, data.prior, center[block], deviation[block])
            if self.tilting:
                tilt_kernels.deviations_with_tilts(
                    normal[block],
                    self._tilt_equations(data, part),
                    data.prior,
                    self._tilt_prior(data),
                    part,
                    deviation[block],
                    tilt_variance[block],
                )

        each_block(work, blocks(len(rows), _BLOCK))

    def reweigh(self, data: Observations, rows: IntArray) -> None:
        """Update weights, losses and misfits of `rows` (N,)."""

        def work(block: slice) -> None:
            kernels.reweigh(
                data.observed,
                data.precision,
                self.lobes,
                self.estimate,
                data.mean,
                data.prior,
                rows[block],
                self.loss_kind,
                _WIDTH,
                self.scale,
                self.weight,
                self.loss,
                self.misfit,
            )

        each_block(work, blocks(len(rows), _BLOCK))
        if self.tilting:
            assert data.tilt_sigma is not None
            square = (self.tilt[rows] ** 2).sum(1) / (TILT_FREEDOM * data.tilt_sigma[rows] ** 2)
            self.loss[rows] += 0.5 * (TILT_FREEDOM + 2) * np.log1p(square)
