"""A quick look at whether the scan's normals under a pose show the relief of the model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.registration.grid_icp import NearestGrid
from scan2albedo.registration.oriented_points import OrientedPoints
from scan2albedo.registration.relief import correlation, without_quadratic_trend

FloatArray = NDArray[np.float64]

_FARTHEST_MM = 15.0
_LEAST_NORMAL_Z = 0.3
_FEWEST = 60


def normal_relief(
    grid: NearestGrid, model: OrientedPoints, rotation: FloatArray, translation: FloatArray
) -> float:
    """Return the correlation of model and scan slopes without their quadratic trend, -1 ... 1.

    Slopes come from the normals of the model samples and of the scan samples nearest to them; the
    result is lessened by the square root of the part of the model that has a near scan sample.

    Parameters
    ----------
    grid : NearestGrid
        Of the scan.
    model : OrientedPoints
    rotation, translation : (3, 3) and (3,) float64
        `scan_from_model`.
    """
    placed = model.points @ rotation.T + translation
    index = grid.nearest_samples(placed)
    normals = grid.samples.normals[index] @ rotation
    offset = grid.samples.points[index] - placed
    near = np.einsum("ij,ij->i", offset, offset) < _FARTHEST_MM**2
    front = model.normals[:, 2] > _LEAST_NORMAL_Z
    used = front & near & (index >= 0) & (normals[:, 2] > 0)
    if used.sum() < _FEWEST:
        return 0.0
    position = model.points[used, :2] / np.abs(model.points[:, :2]).max()
    weights = model.areas[used]
    slopes = np.concatenate([_slopes(model.normals[used]), _slopes(normals[used])], 1)
    relief = without_quadratic_trend(slopes, position, weights)
    alike = correlation(relief[:, :2].ravel(), relief[:, 2:].ravel(), np.repeat(weights, 2))
    return alike * float(np.sqrt(used.sum() / front.sum()))


def _slopes(normals: FloatArray) -> FloatArray:
    return normals[:, :2] / np.maximum(normals[:, 2:], _LEAST_NORMAL_Z)
