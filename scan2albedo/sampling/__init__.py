"""Sampling a surface and its texture into a geometry image.

The package is not called ``geometry_image`` because that name belongs to the function
`scan2albedo.geometry_image`.
"""

from scan2albedo.sampling.face import geometry_image
from scan2albedo.sampling.model_free import geometry_image_of_scan
from scan2albedo.sampling.texture_lookup import LookupOptions

__all__ = ["LookupOptions", "geometry_image", "geometry_image_of_scan"]
