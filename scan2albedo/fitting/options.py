"""Everything that can be set about the fit."""

from dataclasses import dataclass
from math import inf

MOST_LEVELS = 5
"""Each level quadruples the samples: 5 make two million of the default model's faces."""
GATE_MM = (20.0, 3.0)
"""Scan points farther than this exert no force, first and last stage."""


@dataclass(frozen=True)
class FitOptions:
    """How `fit` deforms the model; lengths in mm.

    Stiffness is given as a length: features of the displacement shorter than it are smoothed away,
    longer ones follow the scan. It falls geometrically from the first to the last stage.
    """

    levels: tuple[int, ...] = (0, 0, 0, 1, 1, 1, 1, 1)
    """Loop refinements whose limit vertices feel forces, one entry a stage: coarse to fine."""
    finest_level: int = 2
    """Refinement of a short last stage for scans at least as fine as its samples; 0 leaves it out."""
    steps: int = 10
    """Most time steps a stage."""
    bending_mm: tuple[float, float] = (40.0, 0.9)
    """Thin-plate smoothing length in the first and last stage."""
    tangential: float = 0.01
    """Part of the force along the surface, relative to 1 across it."""
    rigid_iterations: int = 5
    """Most iterations of the pose and scale refinement; 0 keeps the pose given."""
    proportion_iterations: int = 8
    """Iterations of the symmetric stretch that gives the face its proportions; 0 leaves it out."""
    scale_range: tuple[float, float] = (0.75, 1.35)
    """Least and greatest size of the face relative to the model."""
    colors: bool = True
    """Let brows, eyes and lips in the scan's colours draw the model's (models with landmarks)."""
    covers: bool = True
    """Leave out scan that stands far before the eyes, as lenses do (models with landmarks)."""
    smoothing_mm: float = 0.8
    """Scans finer than this are averaged over it, so that their noise does not steer the fit."""

    def __post_init__(self) -> None:
        if not self.levels or not all(0 <= level <= MOST_LEVELS for level in self.levels):
            raise ValueError(f"levels must be one or more numbers from 0 to {MOST_LEVELS}, got {self.levels}")
        if not 0 <= self.finest_level <= MOST_LEVELS:
            raise ValueError(f"finest_level must be from 0 to {MOST_LEVELS}, got {self.finest_level}")
        for name in ("steps", "rigid_iterations", "proportion_iterations", "smoothing_mm"):
            if not 0 <= getattr(self, name) < inf:
                raise ValueError(f"{name} must be finite and 0 or more, got {getattr(self, name)}")
        if not all(0 <= end < inf for end in self.bending_mm):
            raise ValueError(f"bending_mm must be finite and 0 or more at both ends, got {self.bending_mm}")
        if not 0 <= self.tangential <= 1:
            raise ValueError(f"tangential must be from 0 to 1, got {self.tangential}")
        low, high = self.scale_range
        if not 0 < low <= high < inf:
            raise ValueError(
                f"scale_range must be a least and a greatest size above 0, got {self.scale_range}"
            )


def between(ends: tuple[float, float], progress: float) -> float:
    """Return the geometric interpolation between two values at `progress` 0 ... 1, linear when one is 0.

    >>> between((16.0, 1.0), 0.5)
    4.0
    """
    first, last = ends
    if first <= 0 or last <= 0:
        return first + (last - first) * progress
    return float(first * (last / first) ** progress)
