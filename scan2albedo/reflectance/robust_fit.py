"""Settings of `fit_reflectance`, and its reweighted bounded least squares of all vertices at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.blocks import blocks, each_block
from scan2albedo.reflectance import vertex_kernels as kernels

_BLOCK = 128
"""Vertices whose normal equations fit the first cache."""
_WIDTH = 2.4
"""Residual over sigma from which the loss departs from squares; wider for vertices that fit worse."""
_ITERATIONS, _TOLERANCE = 100, 0.02
"""Most reweightings; a vertex is done when no number moves by more than this part of its deviation."""
_KINDS = {"cauchy": kernels.CAUCHY, "charbonnier": kernels.CHARBONNIER, "squares": kernels.NONE}


@dataclass(frozen=True)
class ReflectancePrior:
    """Gaussian prior of a vertex before its pictures, in units of `level`.

    It keeps lobes that no picture shows from fitting noise. A value out of range is a `ValueError`.
    """

    diffuse_mean: float = 1.0
    diffuse_std: float = 5.0
    """`diffuse_mean`, `diffuse_std`: of each channel's albedo; broad."""
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

    def __post_init__(self) -> None:
        if self.loss not in _KINDS:
            raise ValueError(f"loss is {self.loss!r}, expected one of {', '.join(_KINDS)}")
        if not 0 < self.gain_tolerance < math.inf:
            raise ValueError(f"gain_tolerance is {self.gain_tolerance}, expected > 0 and finite")
        for name in ("gain_iterations", "gain_vertices", "least_pairs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected >= 1")


@dataclass(frozen=True)
class Observations:
    """The observations (J, V, 3) of the vertices, with precision 1 / sigma^2, 0 where there is none.

    `lobes` is (J, V, 4); `mean` and `prior` (6,) are means and precisions of the prior.
    """

    observed: FloatArray
    precision: FloatArray
    lobes: FloatArray
    mean: FloatArray
    prior: FloatArray

    def __post_init__(self) -> None:
        # Kernels are compiled anew for every other memory layout.
        for name in ("observed", "precision", "lobes"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))


@dataclass(frozen=True)
class RobustFit:
    """Results for the vertices `rows` (N,), filled by the kernels of `vertex_kernels`; weight (J, N)."""

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


def fit_rows(data: Observations, rows: IntArray, options: ReflectanceFitOptions, meter: Meter) -> RobustFit:
    """Fit the vertices `rows` (N,): least squares first, then weights by residuals until none moves.

    Converged vertices are left out of further steps. The step in which the budget ends is the last.
    """
    state, robust = _State.start(data), options.loss != "squares"
    observations = max(int((data.precision[:, rows] > 0).sum()), 1)

    def reweigh(part: IntArray) -> None:
        state.reweigh(data, part, options)
        meter.count()
        meter.record(state.loss[rows].sum() / observations)

    state.solve(data, rows)
    reweigh(rows)
    moving, iterations = rows, 0
    while robust and len(moving) and iterations < _ITERATIONS and not meter.exhausted:
        before = state.estimate[moving]
        deviation = state.solve(data, moving)
        reweigh(moving)
        iterations += 1
        moving = moving[(np.abs(state.estimate[moving] - before) > _TOLERANCE * deviation).any(1)]
    normal, center, deviation = state.posterior(data, rows)
    estimate = state.estimate[rows]
    settled = ~np.isin(rows, moving) if robust else np.ones(len(rows), bool)
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
    )


@dataclass(frozen=True)
class _State:
    """weight (J, V), estimate (V, 6), scale and loss (V,), misfit (V, 2); filled in place."""

    weight: FloatArray
    estimate: FloatArray
    scale: FloatArray
    loss: FloatArray
    misfit: FloatArray

    @classmethod
    def start(cls, data: Observations) -> _State:
        """Return the state of least squares, before any estimate."""
        pictures, count = data.observed.shape[:2]
        scale, misfit = np.full(count, np.inf), np.zeros((count, 2))
        return cls(np.ones((pictures, count)), np.zeros((count, 6)), scale, np.zeros(count), misfit)

    def solve(self, data: Observations, rows: IntArray) -> FloatArray:
        """Update the estimate of `rows` (N,) and return their standard deviations (N, 6)."""
        found, center, deviation = (np.empty((len(rows), 6)) for _ in range(3))

        def work(block: slice) -> None:
            part = rows[block]
            normal = np.empty((len(part), 3, 14))
            kernels.add_normal_equations(data.observed, data.precision, data.lobes, self.weight, part, normal)
            kernels.solve_bounded(normal, data.mean, data.prior, found[block])
            kernels.solve_free(normal, data.mean, data.prior, center[block], deviation[block])

        each_block(work, blocks(len(rows), _BLOCK))
        self.estimate[rows] = found
        return deviation

    def posterior(self, data: Observations, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return normal equations (N, 3, 14), means and standard deviations (N, 6) without bounds."""
        normal = np.empty((len(rows), 3, 14))
        center, deviation = np.empty((len(rows), 6)), np.empty((len(rows), 6))

        def work(block: slice) -> None:
            kernels.add_normal_equations(
                data.observed, data.precision, data.lobes, self.weight, rows[block], normal[block]
            )
            kernels.solve_free(normal[block], data.mean, data.prior, center[block], deviation[block])

        each_block(work, blocks(len(rows), _BLOCK))
        return normal, center, deviation

    def reweigh(self, data: Observations, rows: IntArray, options: ReflectanceFitOptions) -> None:
        """Update weights, losses and misfits of `rows` (N,)."""

        def work(block: slice) -> None:
            kernels.reweigh(
                data.observed,
                data.precision,
                data.lobes,
                self.estimate,
                data.mean,
                data.prior,
                rows[block],
                _KINDS[options.loss],
                _WIDTH,
                self.scale,
                self.weight,
                self.loss,
                self.misfit,
            )

        each_block(work, blocks(len(rows), _BLOCK))
