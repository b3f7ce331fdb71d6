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
    anchor_limit: int = 600
    """Greatest number of anchors (a scan of a whole room is searched more coarsely)."""
    cone_deg: float = 35.0
    """Greatest angle between the model's +z axis and the averaged outward normal at an anchor."""
    coarse_iterations: tuple[int, int] = (4, 8)
    """Iterations of the first search from every start, and of the second from those that are kept."""
    kept_starts: int = 240
    """Starts that go on to the second search."""
    candidates: int = 8
    """Distinct poses that Open3D refines, at least 6 to be safe."""
    more_candidates: int = 24
    """Further poses that it refines before a scan is refused."""
    icp_iterations: int = 20
    """Most iterations of Open3D's ICP for one pose."""
    scaled_iterations: int = 15
    """Iterations of the ICP that also finds the face's size, for one pose."""
    settling_iterations: int = 30
    """Most iterations at the chosen pose until it settles."""
    coverage_needed: float = 0.25
    """Least part of the model's depth image that the scan must cover to be a face."""
    certainty_needed: float = 0.49
    """Least certainty (see `face_evidence.FaceEvidence`) of a face: whole faces reach 0.55 and more, balls,
    boxes, backs of heads and random bumpy bodies at most 0.48."""
    annealing_evaluations: int = 400
    """Objective evaluations of the depth-derivative annealing where it is forced; 0 leaves it out."""
    annealing_size: int = 64
    """Side of the annealing's depth images in pixels."""
    force_annealing: bool = False
    """Anneal, and take its pose where the surface distance falls; else ICP's pose is the answer."""

    def __post_init__(self) -> None:
        for name in ("scan_spacing_mm", "model_spacing_mm", "anchor_spacing_mm", "cone_deg"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and above 0, got {getattr(self, name)}")
        counts = ["rotation_count", "anchor_limit", "kept_starts", "candidates", "annealing_size"]
        counts += ["icp_iterations", "scaled_iterations", "settling_iterations"]
        values = [(name, getattr(self, name)) for name in counts]
        for name, value in values + [("coarse_iterations", n) for n in self.coarse_iterations]:
            if not value >= 1:
                raise ValueError(f"{name} must be 1 or more, got {value}")
        for name in ("more_candidates", "annealing_evaluations", "coverage_needed", "certainty_needed"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be 0 or more, got {getattr(self, name)}")
