"""A raw 3D face scan goes in; the registered, annotated, evenly sampled and unlit face comes out.

Names are loaded when first used, so importing the package stays quick.

Examples
--------
>>> import scan2albedo as s2a
>>> s2a.AnnotatedFaceModel.default().landmarks.shape
(68, 3)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from scan2albedo.core.version import VERSION

if TYPE_CHECKING:
    from scan2albedo import applications, batch, eyeglasses, recognition, reflectance, report, synthetic
    from scan2albedo.albedo import (
        AlbedoEstimate,
        CommonAlbedo,
        albedo_error,
        estimate_albedo,
        estimate_common_albedo,
    )
    from scan2albedo.core import Budget, EnvironmentLight, GeometryImage, PointLight, RawScan, Trace
    from scan2albedo.errors import Scan2AlbedoError
    from scan2albedo.face_model import Region
    from scan2albedo.fitting import FittedFace, fit
    from scan2albedo.io import load_scan
    from scan2albedo.io.geometry_image_files import read_geometry_image
    from scan2albedo.pipeline.person import PersonResult, process_person
    from scan2albedo.pipeline.process import process
    from scan2albedo.pipeline.quality import Quality
    from scan2albedo.pipeline.result import ProcessResult
    from scan2albedo.pipeline.sequence import SequenceResult, process_sequence
    from scan2albedo.registration import Registration, register
    from scan2albedo.sampling import geometry_image, geometry_image_of_scan
    from scan2albedo.templates import AnnotatedFaceModel

__version__ = VERSION

_HOMES = {
    "albedo": ("AlbedoEstimate", "CommonAlbedo", "albedo_error", "estimate_albedo", "estimate_common_albedo"),
    "core": ("Budget", "EnvironmentLight", "GeometryImage", "PointLight", "RawScan", "Trace"),
    "errors": ("Scan2AlbedoError",),
    "face_model": ("Region",),
    "fitting": ("FittedFace", "fit"),
    "io": ("load_scan",),
    "io.geometry_image_files": ("read_geometry_image",),
    "pipeline.person": ("PersonResult", "process_person"),
    "pipeline.process": ("process",),
    "pipeline.quality": ("Quality",),
    "pipeline.result": ("ProcessResult",),
    "pipeline.sequence": ("SequenceResult", "process_sequence"),
    "registration": ("Registration", "register"),
    "sampling": ("geometry_image", "geometry_image_of_scan"),
    "templates": ("AnnotatedFaceModel",),
}
_SUBPACKAGES = ("applications", "batch", "eyeglasses", "recognition", "reflectance", "report", "synthetic")

__all__ = [
    "AlbedoEstimate",
    "AnnotatedFaceModel",
    "Budget",
    "CommonAlbedo",
    "EnvironmentLight",
    "FittedFace",
    "GeometryImage",
    "PersonResult",
    "PointLight",
    "ProcessResult",
    "Quality",
    "RawScan",
    "Region",
    "Registration",
    "Scan2AlbedoError",
    "SequenceResult",
    "Trace",
    "__version__",
    "albedo_error",
    "applications",
    "batch",
    "estimate_albedo",
    "estimate_common_albedo",
    "eyeglasses",
    "fit",
    "geometry_image",
    "geometry_image_of_scan",
    "load_scan",
    "process",
    "process_person",
    "process_sequence",
    "read_geometry_image",
    "recognition",
    "reflectance",
    "register",
    "report",
    "synthetic",
]


def __getattr__(name: str) -> Any:
    if name in _SUBPACKAGES:
        return import_module(f"{__name__}.{name}")
    home = next((home for home, names in _HOMES.items() if name in names), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
