"""Deform the Annotated Face Model onto a registered scan."""

from scan2albedo.fitting.common_shape import PersonShape, common_shape
from scan2albedo.fitting.fit import fit
from scan2albedo.fitting.options import FitOptions
from scan2albedo.fitting.result import FittedFace

__all__ = ["FitOptions", "FittedFace", "PersonShape", "common_shape", "fit"]
