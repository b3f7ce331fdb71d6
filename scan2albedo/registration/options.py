"""Settings of `register`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RegistrationOptions:
    """Settings of `register`; lengths are millimetres of the scan."""

    scan_spacing_mm: float = 4.0
    """Spacing of the scan samples that the search looks at."""
    model_spacing_mm: float = 6.0
    """Spacing of the model samples."""
    rotation_count: int = 200
    """Super-Fibonacci rotations; each anchor takes those that face outward there."""
    anchor_spacing_mm: float = 30.0
    """Distance between the scan points on which the front of the model is put."""
    coarse_iterations: tuple[int, int] = (4, 8)
    """Iterations of the first search from every start, and of the second from those that are kept."""
    kept_starts: int = 240
    """Starts that go on to the second search."""
    candidates: int = 8
    """Distinct poses that Open3D refines, at least 6 to be safe."""
    icp_iterations: int = 20
    """Most iterations of Open3D's ICP for one pose."""
    scaled_iterations: int = 15
    """Iterations of the ICP that also finds the face's size, for one pose."""
    settling_iterations: int = 30
    """Most iterations at the chosen pose until it settles."""
    annealing_evaluations: int = 400
    """Objective evaluations of the depth-derivative annealing where it is forced; 0 leaves it out."""
    force_annealing: bool = False
    """Anneal, and take its pose where the surface distance falls; else ICP's pose is the answer."""

    def __post_init__(self) -> None:
        for name in ("scan_spacing_mm", "model_spacing_mm", "anchor_spacing_mm"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and above 0, got {getattr(self, name)}")
        counts = ["rotation_count", "kept_starts", "candidates"]
        counts += ["icp_iterations", "scaled_iterations", "settling_iterations"]
        values = [(name, getattr(self, name)) for name in counts]
        for name, value in values + [("coarse_iterations", n) for n in self.coarse_iterations]:
            if not value >= 1:
                raise ValueError(f"{name} must be 1 or more, got {value}")
        if not self.annealing_evaluations >= 0:
            raise ValueError(f"annealing_evaluations must be 0 or more, got {self.annealing_evaluations}")
