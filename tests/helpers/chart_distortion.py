"""How far a chart is from an isometry."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.parametrization import signed_areas


@dataclass(frozen=True)
class ChartDistortion:
    """How far a chart is from an isometry, over faces weighted by their area.

    Parameters
    ----------
    flipped : int
        Faces of zero or negative area in the chart.
    area : float
        Root mean square of log(chart area / surface area) about its mean; 0 = equiareal.
    conformal : float
        Mean ratio of singular values of the face maps; 1 = conformal.
    coverage : float
        Part of the unit square that the chart covers.
    """

    flipped: int
    area: float
    conformal: float
    coverage: float


def chart_distortion(vertices, faces, uv):
    """Measure a chart (V, 2) of a surface (V, 3)."""
    surface, chart = face_areas(vertices, faces), signed_areas(uv, faces)
    weight = surface / surface.sum()
    log_ratio = np.log(np.maximum(np.abs(chart), 1e-300) / np.maximum(surface, 1e-300))
    spread = log_ratio - np.sum(weight * log_ratio)
    edges, chart_edges = (np.diff(points[faces], axis=1).swapaxes(1, 2) for points in (vertices, uv))
    larger, smaller = np.linalg.svd(chart_edges @ np.linalg.pinv(edges), compute_uv=False).T
    ratio = larger / np.maximum(smaller, 1e-300)
    return ChartDistortion(
        flipped=int(np.sum(chart <= 0)),
        area=float(np.sqrt(np.sum(weight * spread**2))),
        conformal=float(np.sum(weight * ratio)),
        coverage=float(chart.sum()),
    )
