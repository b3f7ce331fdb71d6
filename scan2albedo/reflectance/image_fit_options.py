"""Settings of `fit_image`."""

from __future__ import annotations

from dataclasses import dataclass

from scan2albedo.reflectance.lobe_coefficients import Lobe

_PRIOR_WEIGHT = {True: 3e-4, False: 1e-3}


@dataclass(frozen=True)
class ImageFitOptions:
    """Settings of `fit_image`."""

    photometric_weight: float = 2.0
    """Of the mean absolute difference, in units of the image's median colour."""
    prior_weight: float | None = None
    """Of the squared coefficients of reflectance and light. None takes 3e-4 where the observation has a
    transfer and 1e-3 where it has none: shadow that is not modelled must not pass for skin."""
    softness: float = 0.01
    """Differences below this share of the median colour count by their squares (Charbonnier's epsilon)."""
    perceptual_weight: float = 0.1
    """Of the value that `perceptual` returns; see `fit_image`."""
    white_light_weight: float = 0.0
    """Of the squared differences between the channels' light and their mean, over the square of the first
    light's first coefficient. 0, since any other makes albedo no better: at 10, the weight as published, its
    error rose from 0.067 to 0.135 in light as it comes, and from 0.067 to 0.070 where all light was grey."""
    lobe: Lobe = "tilted"
    """Lobe of the highlights where the observation has no transfer; see `shade_environment`."""
    iterations: int = 200
    """After this many steps it stops without having converged."""
    tolerance: float = 1e-5
    """Relative fall of the objective, three steps running, that counts as convergence."""

    def __post_init__(self) -> None:
        for name in ("photometric_weight", "softness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)}")
        for name in ("perceptual_weight", "white_light_weight"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be 0 or more, got {getattr(self, name)}")
        if self.prior_weight is not None and not self.prior_weight >= 0:
            raise ValueError(f"prior_weight must be 0 or more, or None, got {self.prior_weight}")

    def prior_weight_of(self, *, shadows_modelled: bool) -> float:
        """Return `prior_weight`, or what None stands for."""
        return _PRIOR_WEIGHT[shadows_modelled] if self.prior_weight is None else self.prior_weight
