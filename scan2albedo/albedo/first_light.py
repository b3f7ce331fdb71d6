"""Where to look for the light first, and what to make of it when there is no time to search."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.levenberg_marquardt import promise
from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.problem import Solution
from scan2albedo.albedo.residual_problem import ResidualProblem

FloatArray = NDArray[np.float64]

_ROUNDS = 5
_LEAST_RESIDUAL = 1e-3
_HASTY_EVALUATIONS = 4


def shading_direction(level: Level) -> FloatArray:
    """Return the unit direction in which the cells grow bright: V ~ a + b . n in L1, reweighted a few times.

    +z where nothing grows.

    References
    ----------
    .. [1] R. Basri, D. Jacobs, "Lambertian Reflectance and Linear Subspaces", PAMI 25(2), 2003.
    """
    basis = np.column_stack([np.ones(len(level.normal)), level.normal])
    weight: FloatArray = level.weight
    found: FloatArray = np.zeros(4)
    for _ in range(_ROUNDS):
        scaled = basis * weight[:, None]
        found = np.asarray(np.linalg.lstsq(scaled.T @ basis, scaled.T @ level.value, rcond=None)[0], float)
        weight = level.weight / np.maximum(np.abs(basis @ found - level.value), _LEAST_RESIDUAL)
    length = float(np.linalg.norm(found[1:]))
    return found[1:] / length if length > _LEAST_RESIDUAL else np.array([0.0, 0.0, 1.0])


def nearest_first(directions: FloatArray, toward: FloatArray) -> FloatArray:
    """Return the directions (D, 3), those nearest to `toward` first.

    >>> nearest_first(np.eye(3), np.array([0.0, 1.0, 0.0]))[0]
    array([0., 1., 0.])
    """
    return directions[np.argsort(-(directions @ toward), kind="stable")]


def hasty_light(problem: ResidualProblem, model: LightModel, x: FloatArray) -> Solution:
    """Return where a few promised steps from x lead, whatever is left of the budget, and record its cost."""
    cost = np.inf
    for _ in range(_HASTY_EVALUATIONS):
        cost, x = promise(problem, model, x)
    problem.meter.record(cost)
    return Solution(model, x, cost)
