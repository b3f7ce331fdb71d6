"""`ReflectanceFit`: the reflectance of each vertex, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Trace
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance

FloatArray = NDArray[np.float64]

PARAMETERS = ("red", "green", "blue", "weight_1", "weight_8", "weight_64")
"""Columns of everything (V, 6)."""


@dataclass(frozen=True)
class ReflectanceFit:
    """Result of `fit_reflectance`; NaN where a vertex is not known, unless said otherwise.

    Parameters
    ----------
    reflectance : VertexReflectance
    std : (V, 6) float64
        Standard deviation of the posterior without bounds, columns `PARAMETERS`; larger by the misfit where
        residuals are above sigma.
    low, high : (V, 6) float64
        95 % intervals, >= 0; they hold the estimate.
    pair_count : (V,) int64
        Pictures used; 0 for unseen vertices.
    condition : (V,) float64
        Condition number of the observations' matrix, columns not scaled, without the prior; inf where it is
        singular.
    activation : (V, 3) float64
        Largest value over the pictures of each lobe, over its peak: max(0, n.h)^s. 0 for unseen vertices.
    identifiability : (V, 6) float64
        Posterior over prior standard deviation, the former before the misfit: 1 where pictures tell nothing.
    identified : (V, 6) bool
        Identifiability is small enough; False where not known.
    misfit : (V,) float64
        Root of the mean squared residual over sigma, robust; 1 is as the noise says. NaN also where there are
        not more observations than unknowns.
    light_gain : (L, 3) float64
        Strength of each flash, mean 1 over those used; NaN for flashes that lit nothing.
    level : float
        Unit of the prior.
    bounded_albedos : int
        Vertices where an albedo is held at 0.
    settled : (V,) bool
        Known and done when the fit ended.
    converged : bool
        All known vertices are, and the gains; False when the budget or the iterations ended the fit first.
    iterations : int
        Reweightings.
    residual : float
        Robust loss per observation; 1/2 is pure noise.
    trace : Trace
    """

    reflectance: VertexReflectance
    std: FloatArray
    low: FloatArray
    high: FloatArray
    pair_count: NDArray[np.int64]
    condition: FloatArray
    activation: FloatArray
    identifiability: FloatArray
    identified: NDArray[np.bool_]
    misfit: FloatArray
    light_gain: FloatArray
    level: float
    bounded_albedos: int
    settled: NDArray[np.bool_]
    converged: bool
    iterations: int
    residual: float
    trace: Trace

    @property
    def parameters(self) -> FloatArray:
        """(V, 6) albedos and weights, columns `PARAMETERS`."""
        return np.concatenate([self.reflectance.diffuse_linear, self.reflectance.weights], axis=1)
