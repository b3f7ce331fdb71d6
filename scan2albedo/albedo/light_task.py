"""What every search for the light is given, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.problem import Solution
from scan2albedo.albedo.uncertainty import LightUncertainty
from scan2albedo.core import Meter
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.plan import PlanStep
from scan2albedo.geometry.mesh import lengths
from scan2albedo.geometry.rays import RayCaster

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class LightFound:
    """The solution, the plan's rows, and the mesh that casts shadows (None where they are left out).

    Where it was judged, how sure the light is, and (H, W) the relative deviation of the albedo that follows.
    """

    solution: Solution
    steps: list[PlanStep]
    caster: RayCaster | None
    uncertainty: LightUncertainty | None = None
    albedo_deviation: FloatArray | None = None


@dataclass(frozen=True)
class LightTask:
    """An image whose light is asked for.

    Parameters
    ----------
    image : GeometryImage
    usable : (H, W) bool
    brdf : str
    view : (float, float, float)
        Unit.
    options : EstimateOptions
    meter : Meter
    """

    image: GeometryImage
    usable: NDArray[np.bool_]
    brdf: str
    view: tuple[float, float, float]
    options: EstimateOptions
    meter: Meter

    def model(self, lights: int) -> LightModel:
        """Return the plain model of so many lights."""
        radius = float(lengths(self.image.position)[self.image.mask].max()) or 1.0
        return LightModel(lights, self.brdf, self.view, radius)
