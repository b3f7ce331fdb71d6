"""Settings of `fit_reflectance`."""

from __future__ import annotations

import math
from dataclasses import dataclass

LOSSES = ("cauchy", "charbonnier", "squares")


@dataclass(frozen=True)
class ReflectancePrior:
    """What is believed of a vertex before its pictures: Gaussian, in units of `level`.

    Without it lobes that no picture hit would be as large as noise likes.

    Parameters
    ----------
    diffuse_mean, diffuse_std : float
        Of each channel's albedo; broad.
    weights_mean, weights_std : tuple of three floats
        Of the lobes with exponents 1, 8 and 64.
    level : float or None
        Unit of the others; None takes the median of the albedos without highlights, since strength of the
        flash and albedo cannot be told apart.

    Raises
    ------
    ValueError
        When a value is outside its range.
    """

    diffuse_mean: float = 1.0
    diffuse_std: float = 5.0
    weights_mean: tuple[float, float, float] = (0.1, 0.1, 0.1)
    weights_std: tuple[float, float, float] = (0.3, 0.3, 0.3)
    level: float | None = None

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
    """How vertices are fitted.

    Parameters
    ----------
    prior : ReflectancePrior
    loss : {"cauchy", "charbonnier", "squares"}
        Of a picture's residual, its three channels together: what no model of the light explains, a shadow
        that the mesh does not cast for instance, pulls little or not at all.
    width : float
        Residual over sigma from which the loss departs from squares; vertices that fit worse than sigma says
        have a wider one.
    iterations : int
        Most reweightings.
    tolerance : float
        A vertex is done when no number moves by more than this part of its standard deviation.
    light_gains : bool
        Estimate the strength of each flash in each channel, mean 1 over the flashes, beside the reflectance.
    gain_iterations : int
        Most alternations.
    gain_vertices : int
        Vertices that gains are found from, evenly chosen.
    gain_tolerance : float
        Gains are done when none moves by more.
    least_pairs : int
        A vertex with fewer pictures of a channel is not known.
    identified_below : float
        Posterior over prior standard deviation below which a number counts as identified.

    Raises
    ------
    ValueError
        When a value is outside its range.
    """

    prior: ReflectancePrior = ReflectancePrior()
    loss: str = "cauchy"
    width: float = 2.4
    iterations: int = 100
    tolerance: float = 0.02
    light_gains: bool = False
    gain_iterations: int = 50
    gain_vertices: int = 2000
    gain_tolerance: float = 1e-5
    least_pairs: int = 1
    identified_below: float = 0.3

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise ValueError(f"loss is {self.loss!r}, expected one of {', '.join(LOSSES)}")
        for name in ("width", "tolerance", "gain_tolerance", "identified_below"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected > 0 and finite")
        for name in ("iterations", "gain_iterations", "gain_vertices", "least_pairs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected >= 1")
