"""A raw 3D face scan goes in; the registered, annotated, evenly sampled and unlit face comes out.

Names are loaded when first used, so importing the package stays quick.

Examples
--------
>>> import scan2albedo as s2a
>>> s2a.AnnotatedFaceModel.default().landmarks.shape
(68, 3)
"""

from typing import TYPE_CHECKING

from scan2albedo.core.version import VERSION
from scan2albedo.lazy import names_when_asked

if TYPE_CHECKING:
    from scan2albedo import (
        applications as applications,
        batch as batch,
        eyeglasses as eyeglasses,
        recognition as recognition,
        reflectance as reflectance,
        report as report,
        synthetic as synthetic,
    )
    from scan2albedo.albedo import (
        AlbedoEstimate as AlbedoEstimate,
        CommonAlbedo as CommonAlbedo,
        albedo_error as albedo_error,
        estimate_albedo as estimate_albedo,
        estimate_common_albedo as estimate_common_albedo,
    )
    from scan2albedo.core import (
        Budget as Budget,
        EnvironmentLight as EnvironmentLight,
        GeometryImage as GeometryImage,
        PointLight as PointLight,
        RawScan as RawScan,
        Trace as Trace,
    )
    from scan2albedo.errors import Scan2AlbedoError as Scan2AlbedoError
    from scan2albedo.face_model import Region as Region
    from scan2albedo.fitting import FittedFace as FittedFace, fit as fit
    from scan2albedo.io import load_scan as load_scan
    from scan2albedo.io.geometry_image_files import read_geometry_image as read_geometry_image
    from scan2albedo.pipeline.person import PersonResult as PersonResult, process_person as process_person
    from scan2albedo.pipeline.process import process as process
    from scan2albedo.pipeline.quality import Quality as Quality
    from scan2albedo.pipeline.result import ProcessResult as ProcessResult
    from scan2albedo.pipeline.sequence import (
        SequenceResult as SequenceResult,
        process_sequence as process_sequence,
    )
    from scan2albedo.registration import Registration as Registration, register as register
    from scan2albedo.sampling import (
        geometry_image as geometry_image,
        geometry_image_of_scan as geometry_image_of_scan,
    )
    from scan2albedo.templates import AnnotatedFaceModel as AnnotatedFaceModel

__version__ = VERSION
__getattr__, __dir__, __all__ = names_when_asked(__name__, __file__)
