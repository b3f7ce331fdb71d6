"""What registration returns."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Trace


@dataclass(frozen=True)
class Registration:
    """Rigid pose of a scan in the model's frame.

    Parameters
    ----------
    model_from_scan : (4, 4) float64
        Maps scan points (mm) into the model's frame.
    rmse_mm : float
        Root mean square distance model -> scan over the inliers at the final pose.
    depth_error : float or None
        Depth-derivative objective at the final pose; None when annealing did not run.
    converged : bool
        False when a budget ended the search.
    confidence : float
        0 ... 1: how clearly a face was found (see `registration.register`).
    iterations : int
        Objective evaluations and ICP iterations spent.
    trace : Trace
        Stages "icp" and "tight_icp" (mm), and "depth_annealing" (objective) when forced.
    notes : tuple of (step, ran, reason, evidence)
        What the steps inside decided, for the plan.
    face_scale : float
        Size of the face relative to the model's, about the model's origin; `model_from_scan` is rigid
        and does not contain it.
    """

    model_from_scan: NDArray[np.float64]
    rmse_mm: float
    depth_error: float | None
    converged: bool
    confidence: float
    iterations: int
    trace: Trace
    notes: tuple[tuple[str, bool, str, str], ...] = field(default=())
    face_scale: float = 1.0
