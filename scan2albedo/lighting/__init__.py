"""Lights, reflectance models and shadows."""

from scan2albedo.lighting.point_light import PointLight

__all__ = ["PointLight"]
