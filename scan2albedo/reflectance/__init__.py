"""Reflectance of faces, vertex by vertex: from flash photographs, and as a morphable model."""

from scan2albedo.reflectance.environment_shading import EnvironmentShading, shade_environment
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance

__all__ = ["EXPONENTS", "EnvironmentShading", "VertexReflectance", "shade_environment"]
