"""Settings of `refine_geometry`."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class GeometryFitOptions:
    """How pose and shape are fitted to one image.

    Raises
    ------
    ValueError
        When a value is outside its range.
    """

    landmark_weight: float = 0.2
    """Of the mean squared distance of landmarks, in mm at the face's depth."""
    photometric_weight: float = 2.0
    """Of the mean absolute difference of colours, in units of the image's median colour."""
    prior_weight: float = 1e-3
    """Of the squared coefficients."""
    softness: float = 0.01
    """Differences below this share of the median colour count by their squares (Charbonnier's epsilon)."""
    landmark_softness_mm: float | None = None
    """Landmarks farther off than this count by their distance, not its square; None for squares alone."""
    contour: bool = True
    """Use landmarks 0 ... 16, along the jaw, which slide over the face where its outline is meant."""
    blur_edges: tuple[float, ...] = (0.3,)
    """The image is smoothed by these standard deviations, one after the other, in mean edges of the mesh: the
    reflectance does not hold what is finer than the spacing of its vertices."""
    view_cosine: float = 0.2
    """Vertices whose normals have less than this to the line of sight do not count."""
    margin_px: float = 2.0
    """Nor do those nearer than this to an edge of the surface in the image."""
    refresh_steps: int = 5
    """After so many steps it is settled anew which vertices count."""
    rounds: int = 10
    """Most times that this is settled, for each of `blur_edges`."""
    landmark_steps: int = 100
    """Most steps with landmarks alone."""
    tolerance: float = 1e-4
    """Relative fall of the objective, three steps running or one round, that counts as convergence."""
    landmark_growth: float = 1.5
    """Photometry is not believed when it makes the landmarks' error larger than this times the error without,
    and `landmark_slack_px`."""
    landmark_slack_px: float = 0.5
    largest_rmse: float = 0.25
    """Nor when the colours' relative rmse stays above this."""

    def __post_init__(self) -> None:
        positive = ["landmark_weight", "photometric_weight", "softness", "largest_rmse", "landmark_growth"]
        if self.landmark_softness_mm is not None:
            positive.append("landmark_softness_mm")
        for name in positive:
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be above 0 and finite, got {getattr(self, name)}")
        for name in ("prior_weight", "margin_px", "tolerance", "landmark_slack_px"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be 0 or more and finite, got {getattr(self, name)}")
        for name in ("refresh_steps", "rounds", "landmark_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if not 0 <= self.view_cosine < 1:
            raise ValueError(f"view_cosine must be within [0, 1), got {self.view_cosine}")
        if not self.blur_edges or not all(0 <= blur < math.inf for blur in self.blur_edges):
            raise ValueError(f"blur_edges must hold one or more finite numbers >= 0, got {self.blur_edges}")
