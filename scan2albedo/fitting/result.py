"""What the fit returns."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Trace
from scan2albedo.face_model import AnnotatedFaceModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class FittedFace:
    """The model deformed onto a scan; everything in the model's frame, mm.

    Parameters
    ----------
    vertices : (V, 3) float64
        Limit surface points, V from `levels` refinements of the control mesh.
    faces : (F, 3) int64
    uv : (V, 2) float64
        Chart coordinates of `vertices`.
    region : (F,) uint8
        Region index of each face.
    control_points : (C, 3) float64
        Deformed control mesh.
    landmarks : (68, 3) float64 or None
    residual_mm : (V,) float64
        Distance of each vertex to the scan; NaN where the scan has no surface near (hole, outside).
    model_from_scan : (4, 4) float64
        Pose used; the fit may refine it.
    template_vertices : (T, 3) float64 or None
        The model's own template vertices carried along (`AnnotatedFaceModel.from_mesh`).
    levels : int
        Loop refinements of `vertices`.
    converged : bool
        False when a budget ended the fit, or something holds it far from balance (``imbalance_mm``).
    iterations : int
    trace : Trace
        Stage "fit", mm.
    model : AnnotatedFaceModel
    metrics : mapping of str to float
        Mean, median, p95 residual, coverage, flipped faces; how far the surface would still move
        (``imbalance_mm``), and the RMS logarithm of how its edges were stretched (``strain``): for
        result.json.
    """

    vertices: FloatArray
    faces: NDArray[np.int64]
    uv: FloatArray
    region: NDArray[np.uint8]
    control_points: FloatArray
    landmarks: FloatArray | None
    residual_mm: FloatArray
    model_from_scan: FloatArray
    template_vertices: FloatArray | None
    levels: int
    converged: bool
    iterations: int
    trace: Trace
    model: AnnotatedFaceModel
    metrics: dict[str, float] = field(default_factory=dict)
