"""How sure the light is, and what that does to the albedo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.problem import Solution
from scan2albedo.albedo.residual_problem import ResidualProblem
from scan2albedo.core.point_light import PointLight

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Alternative:
    """Other lights that explain the image nearly as well: a second minimum of the objective.

    Parameters
    ----------
    lights : tuple of PointLight
    excess : float
        By which part their cost is larger, before roughness and the like are freed; negative where one light
        found may be two close ones.
    """

    lights: tuple[PointLight, ...]
    excess: float


@dataclass(frozen=True)
class LightUncertainty:
    """Standard deviations at the optimum, in the order of `AlbedoEstimate.lights`.

    They hold as far as the model of the light does: a surface that is wrong, or a lamp of another kind, is
    not part of them.

    Parameters
    ----------
    direction_rad : tuple of float
        Of each light's direction, root mean square over its two coordinates.
    intensity : tuple of float
        Of each intensity relative to ambient, as a part of it.
    albedo : float
        Root mean square over the surface of the albedo's relative deviation, best scale removed.
    alternatives : tuple of Alternative
        Best first; empty where the objective has one minimum only.
    """

    direction_rad: tuple[float, ...]
    intensity: tuple[float, ...]
    albedo: float
    alternatives: tuple[Alternative, ...] = ()

    @property
    def ambiguous(self) -> bool:
        """Whether other lights explain the image nearly as well."""
        return bool(self.alternatives)

    def figures(self) -> dict[str, object]:
        """Return the figures for result.json."""
        return {
            "direction_deviation_deg": [round(math.degrees(d), 4) for d in self.direction_rad],
            "intensity_deviation": [round(d, 5) for d in self.intensity],
            "albedo_deviation": round(self.albedo, 6),
            "alternatives": [
                {
                    "lights_deg": [
                        [round(math.degrees(angle), 2) for angle in (light.azimuth_rad, light.elevation_rad)]
                        for light in other.lights
                    ],
                    "excess": round(other.excess, 5),
                }
                for other in self.alternatives
            ],
        }


def light_uncertainty(
    problem: ResidualProblem, solution: Solution, others: Sequence[Alternative] = ()
) -> tuple[LightUncertainty, FloatArray]:
    """Return how sure a solution is, and (N,) the relative deviation of each cell's albedo that follows.

    The covariance of the parameters, robust to texture that correlates nearby (see
    `ResidualProblem.covariance`), carried to the albedo by its derivatives.
    """
    model, x = solution.model, solution.x
    covariance = problem.covariance(model, x)
    rows = solution.hypothesis.rows
    order = np.argsort(-rows[:, 4], kind="stable")
    variance = np.maximum(np.diag(covariance), 0.0)
    direction = tuple(float(np.sqrt(variance[3 * k : 3 * k + 2].mean())) for k in order)
    intensity = tuple(float(np.sqrt(variance[3 * k + 2])) for k in order)
    slopes = problem.albedo_slopes(model, x)
    cells = np.sqrt(np.maximum(np.einsum("in,ij,jn->n", slopes, covariance, slopes), 0.0))
    overall = float(np.sqrt(np.mean(cells**2)))
    return LightUncertainty(direction, intensity, overall, tuple(others)), cells
