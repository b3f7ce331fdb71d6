"""Light found in a geometry image and divided out: the albedo."""

from scan2albedo.albedo.common_albedo import CommonAlbedo, estimate_common_albedo
from scan2albedo.albedo.estimate import estimate_albedo
from scan2albedo.albedo.options import OPTIONAL_STEPS, EstimateOptions
from scan2albedo.albedo.result import AlbedoError, AlbedoEstimate, albedo_error
from scan2albedo.albedo.uncertainty import Alternative, LightUncertainty

__all__ = [
    "OPTIONAL_STEPS",
    "AlbedoError",
    "AlbedoEstimate",
    "Alternative",
    "CommonAlbedo",
    "EstimateOptions",
    "LightUncertainty",
    "albedo_error",
    "estimate_albedo",
    "estimate_common_albedo",
]
