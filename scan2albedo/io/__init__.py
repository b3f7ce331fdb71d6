"""Reading and writing of scans, images, geometry images and results."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

# Imported at once: the submodule has the function's name, and the import system would put it in its place.
from scan2albedo.io.load_scan import load_scan

if TYPE_CHECKING:
    from scan2albedo.io.atomic import atomic_path
    from scan2albedo.io.color import linear_to_srgb, srgb_to_linear
    from scan2albedo.io.geometry_image import GeometryImage
    from scan2albedo.io.images import read_image_linear, write_exr, write_image, write_png
    from scan2albedo.io.raw_scan import RawScan

_MODULE_OF = {
    "GeometryImage": "geometry_image",
    "RawScan": "raw_scan",
    "atomic_path": "atomic",
    "linear_to_srgb": "color",
    "read_image_linear": "images",
    "srgb_to_linear": "color",
    "write_exr": "images",
    "write_image": "images",
    "write_png": "images",
}

__all__ = [
    "GeometryImage",
    "RawScan",
    "atomic_path",
    "linear_to_srgb",
    "load_scan",
    "read_image_linear",
    "srgb_to_linear",
    "write_exr",
    "write_image",
    "write_png",
]


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
