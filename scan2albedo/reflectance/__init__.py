"""Reflectance of faces, vertex by vertex: from flash photographs, and as a morphable model.

After Y. Han, Z. Wang, F. Xu, "Learning a 3D Morphable Face Reflectance Model from Low-cost Data", CVPR 2023,
and its supplement, which the modules cite as Han, Wang, Xu.
"""

from scan2albedo.reflectance.capture_files import (
    CaptureFiles,
    PhotographFiles,
    read_capture,
    read_photograph,
    write_capture,
)
from scan2albedo.reflectance.environment_shading import LightResponse, shade_environment
from scan2albedo.reflectance.face_fit import FaceFit, fit_face
from scan2albedo.reflectance.finetune import FineTuning, finetune
from scan2albedo.reflectance.geometry_fit import GeometryFit, refine_geometry
from scan2albedo.reflectance.image_fit import ImageFit, fit_image
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel
from scan2albedo.reflectance.olat import OlatImages, OlatOptions, extract_olat
from scan2albedo.reflectance.photograph import ImageObservation, light_transfer, observe_photograph
from scan2albedo.reflectance.point_light_lobes import lobe_slopes, point_light_lobes, point_light_radiance
from scan2albedo.reflectance.reflectance_files import MeshReflectance, read_reflectance, write_reflectance
from scan2albedo.reflectance.robust_fit import ReflectanceFitOptions
from scan2albedo.reflectance.shape_model import MorphableShapeModel
from scan2albedo.reflectance.vertex_fit import (
    PARAMETERS,
    ReflectanceFit,
    RelightingError,
    fit_reflectance,
    relighting_error,
)
from scan2albedo.reflectance.vertex_reflectance import (
    EXPONENTS,
    VertexReflectance,
    lobe_weights_of_phong,
    reflectance_from_albedo,
)
from scan2albedo.reflectance.vertex_samples import (
    CaptureRig,
    VertexSamples,
    rig_of_head_poses,
    sample_vertices,
)
from scan2albedo.statistics.linear_model import LinearModel

__all__ = [
    "EXPONENTS",
    "PARAMETERS",
    "CaptureFiles",
    "CaptureRig",
    "FaceFit",
    "FineTuning",
    "GeometryFit",
    "ImageFit",
    "ImageObservation",
    "LightResponse",
    "LightingModel",
    "LinearModel",
    "MeshReflectance",
    "MorphableReflectanceModel",
    "MorphableShapeModel",
    "OlatImages",
    "OlatOptions",
    "PhotographFiles",
    "ReflectanceFit",
    "ReflectanceFitOptions",
    "RelightingError",
    "VertexReflectance",
    "VertexSamples",
    "extract_olat",
    "finetune",
    "fit_face",
    "fit_image",
    "fit_reflectance",
    "light_transfer",
    "lobe_slopes",
    "lobe_weights_of_phong",
    "observe_photograph",
    "point_light_lobes",
    "point_light_radiance",
    "read_capture",
    "read_photograph",
    "read_reflectance",
    "refine_geometry",
    "reflectance_from_albedo",
    "relighting_error",
    "rig_of_head_poses",
    "sample_vertices",
    "shade_environment",
    "write_capture",
    "write_reflectance",
]
