"""Reflectance of faces, vertex by vertex: from flash photographs, and as a morphable model."""

from scan2albedo.reflectance.environment_shading import EnvironmentShading, shade_environment
from scan2albedo.reflectance.finetune import FineTuneOptions, FineTuning, finetune
from scan2albedo.reflectance.generated_environments import generated_environment
from scan2albedo.reflectance.image_fit import ImageFit, ImageFitOptions, fit_image
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import ModelReflectance, MorphableReflectanceModel, Projection
from scan2albedo.reflectance.scan_reflectance import lobe_weights_of_phong, reflectance_from_albedo
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance

__all__ = [
    "EXPONENTS",
    "EnvironmentShading",
    "FineTuneOptions",
    "FineTuning",
    "ImageFit",
    "ImageFitOptions",
    "ImageObservation",
    "LightingModel",
    "ModelReflectance",
    "MorphableReflectanceModel",
    "Projection",
    "VertexReflectance",
    "finetune",
    "fit_image",
    "generated_environment",
    "lobe_weights_of_phong",
    "reflectance_from_albedo",
    "shade_environment",
]
