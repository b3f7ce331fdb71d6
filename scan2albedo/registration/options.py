"""Settings of `register`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RegistrationOptions:
    """Settings of `register`."""

    anchor_spacing_mm: float = 30.0
    """Distance between the scan points on which the front of the model is put."""
    kept_starts: int = 240
    """Starts that go on to the second search."""
    candidates: int = 8
    """Distinct poses that Open3D refines, at least 6 to be safe."""
    settling_iterations: int = 30
    """Most iterations at the chosen pose until it settles."""
    annealing_evaluations: int = 400
    """Objective evaluations of the depth-derivative annealing where it is forced; 0 leaves it out."""
    force_annealing: bool = False
    """Anneal, and take its pose where the surface distance falls; else ICP's pose is the answer."""

    def __post_init__(self) -> None:
        if not 0 < self.anchor_spacing_mm < np.inf:
            raise ValueError(f"anchor_spacing_mm must be finite and above 0, got {self.anchor_spacing_mm}")
        for name in ("kept_starts", "candidates", "settling_iterations"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if not self.annealing_evaluations >= 0:
            raise ValueError(f"annealing_evaluations must be 0 or more, got {self.annealing_evaluations}")
