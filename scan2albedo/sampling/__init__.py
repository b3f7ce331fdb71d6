"""Sampling a surface and its texture into a geometry image.

`scan2albedo.geometry_image` is the function; import modules of this folder by their full names.
"""

from scan2albedo.sampling.geometry_images import geometry_image, geometry_image_of_scan

__all__ = ["geometry_image", "geometry_image_of_scan"]
