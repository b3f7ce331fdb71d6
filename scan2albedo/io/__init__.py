"""Reading and writing of scans, images, geometry images and results."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

# Imported at once: the submodule has the function's name, and the import system would put it in its place.
from scan2albedo.io.load_scan import load_scan

if TYPE_CHECKING:
    from scan2albedo.io.atomic import atomic_path
    from scan2albedo.io.color import linear_to_srgb, srgb_to_linear
    from scan2albedo.io.geometry_image_files import (
        read_geometry_image,
        write_geometry_image,
        write_geometry_image_exr,
    )
    from scan2albedo.io.glb import write_glb
    from scan2albedo.io.images import read_image_linear, write_exr, write_image, write_png
    from scan2albedo.io.input_hash import input_sha256
    from scan2albedo.io.result_json import RegistrationRecord, ResultRecord, read_record, write_record
    from scan2albedo.io.skinned_glb import write_skinned_glb

_MODULE_OF = {
    "RegistrationRecord": "result_json",
    "ResultRecord": "result_json",
    "atomic_path": "atomic",
    "input_sha256": "input_hash",
    "linear_to_srgb": "color",
    "read_geometry_image": "geometry_image_files",
    "read_image_linear": "images",
    "read_record": "result_json",
    "srgb_to_linear": "color",
    "write_exr": "images",
    "write_geometry_image": "geometry_image_files",
    "write_geometry_image_exr": "geometry_image_files",
    "write_glb": "glb",
    "write_image": "images",
    "write_png": "images",
    "write_record": "result_json",
    "write_skinned_glb": "skinned_glb",
}

__all__ = [
    "RegistrationRecord",
    "ResultRecord",
    "atomic_path",
    "input_sha256",
    "linear_to_srgb",
    "load_scan",
    "read_geometry_image",
    "read_image_linear",
    "read_record",
    "srgb_to_linear",
    "write_exr",
    "write_geometry_image",
    "write_geometry_image_exr",
    "write_glb",
    "write_image",
    "write_png",
    "write_record",
    "write_skinned_glb",
]


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
