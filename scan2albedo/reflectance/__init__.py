"""Reflectance of faces, vertex by vertex: from flash photographs, and as a morphable model."""

from scan2albedo.reflectance.capture_rig import CaptureRig, rig_of_head_poses
from scan2albedo.reflectance.fit_options import ReflectanceFitOptions, ReflectancePrior
from scan2albedo.reflectance.fit_result import PARAMETERS, ReflectanceFit
from scan2albedo.reflectance.olat import CaptureDiagnostic, OlatImages, OlatOptions, extract_olat
from scan2albedo.reflectance.point_light_lobes import point_light_lobes, point_light_radiance
from scan2albedo.reflectance.relighting_error import RelightingError, relighting_error
from scan2albedo.reflectance.vertex_fit import fit_reflectance
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance
from scan2albedo.reflectance.vertex_samples import SamplingOptions, VertexSamples, sample_vertices

__all__ = [
    "EXPONENTS",
    "PARAMETERS",
    "CaptureDiagnostic",
    "CaptureRig",
    "OlatImages",
    "OlatOptions",
    "ReflectanceFit",
    "ReflectanceFitOptions",
    "ReflectancePrior",
    "RelightingError",
    "SamplingOptions",
    "VertexReflectance",
    "VertexSamples",
    "extract_olat",
    "fit_reflectance",
    "point_light_lobes",
    "point_light_radiance",
    "relighting_error",
    "rig_of_head_poses",
    "sample_vertices",
]
