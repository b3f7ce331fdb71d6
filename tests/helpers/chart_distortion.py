"""How far a chart is from an isometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
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


def chart_distortion(vertices: FloatArray, faces: IntArray, uv: FloatArray) -> ChartDistortion:
    """Measure a chart (V, 2) of a surface (V, 3)."""
    surface, chart = face_areas(vertices, faces), signed_areas(uv, faces)
    weight = surface / surface.sum()
    log_ratio = np.log(np.maximum(np.abs(chart), 1e-300) / np.maximum(surface, 1e-300))
    spread = log_ratio - np.sum(weight * log_ratio)
    ratio = _singular_value_ratio(vertices, faces, uv)
    return ChartDistortion(
        flipped=int(np.sum(chart <= 0)),
        area=float(np.sqrt(np.sum(weight * spread**2))),
        conformal=float(np.sum(weight * ratio)),
        coverage=float(chart.sum()),
    )


def _singular_value_ratio(vertices: FloatArray, faces: IntArray, uv: FloatArray) -> FloatArray:
    """(F,) ratio of the larger to the smaller stretch of each face map (surface to chart)."""
    edge_1 = vertices[faces[:, 1]] - vertices[faces[:, 0]]
    edge_2 = vertices[faces[:, 2]] - vertices[faces[:, 0]]
    length = np.maximum(np.linalg.norm(edge_1, axis=1), 1e-300)
    along = np.einsum("ij,ij->i", edge_2, edge_1) / length
    height = np.maximum(np.sqrt(np.maximum(np.einsum("ij,ij->i", edge_2, edge_2) - along**2, 0)), 1e-300)
    chart_1, chart_2 = uv[faces[:, 1]] - uv[faces[:, 0]], uv[faces[:, 2]] - uv[faces[:, 0]]
    column_1 = chart_1 / length[:, None]
    column_2 = (chart_2 - column_1 * along[:, None]) / height[:, None]
    singular = np.linalg.svd(np.stack([column_1, column_2], 2), compute_uv=False)
    return singular[:, 0] / np.maximum(singular[:, 1], 1e-300)
