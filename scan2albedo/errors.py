"""The errors scan2albedo raises on purpose; every message names the thing, what is wrong and what to do."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, marks that turn the direction of text, and bytes of names that are not UTF-8."""


def printable(text: str) -> str:
    """Return text from a file or of a file's name without what a terminal would obey or cannot show.

    Control characters, line breaks among them, direction marks and bytes that are not UTF-8 are escaped.

    >>> print(printable("skin\\x1b[2J\\n"))
    skin\\x1b[2J\\x0a
    """

    def escaped(found: re.Match[str]) -> str:
        code = ord(found[0])
        if 0xDC80 <= code <= 0xDCFF:  # as Python holds a byte of a file's name that it cannot decode
            code -= 0xDC00
        return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"

    return _UNPRINTABLE.sub(escaped, text)


class Scan2AlbedoError(Exception):
    """Base of every error that scan2albedo raises about its input or its work; its text is `one_line`."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*(one_line(a) if isinstance(a, str) else a for a in arguments))


class ScanError(Scan2AlbedoError):
    """A scan file or a `RawScan` cannot be used."""


class TooLargeError(ScanError):
    """A file declares or holds more than is read of one; nothing of that size was made room for."""


class UnitError(ScanError):
    """The size of a scan fits a head in no unit; the unit has to be given."""


class ModelError(Scan2AlbedoError):
    """A face model file or template mesh cannot be used."""


class RegistrationError(Scan2AlbedoError):
    """No trustworthy pose was found: most often the scan holds no face."""


class NoFaceError(RegistrationError):
    """Nothing in the scan resembles a face of its size.

    `confidence` is the probability that the best pose, `model_from_scan` (4, 4), is that of a face all the
    same; both are None where unknown.
    """

    def __init__(
        self,
        message: str,
        confidence: float | None = None,
        model_from_scan: NDArray[np.float64] | None = None,
    ) -> None:
        super().__init__(message)
        self.confidence = confidence
        self.model_from_scan = model_from_scan


class InsideOutError(RegistrationError):
    """There is a face, but all triangles of the scan face inward (`RawScan.inside_out` turns them)."""


class FitError(Scan2AlbedoError):
    """The model cannot be deformed onto the scan."""


class GeometryImageError(Scan2AlbedoError):
    """A surface cannot be sampled into a geometry image."""


class LightingError(Scan2AlbedoError):
    """Light or albedo cannot be estimated from an image."""


class EyeglassesError(Scan2AlbedoError):
    """Eyeglasses cannot be weighted, deformed or registered."""


class RecognitionError(Scan2AlbedoError):
    """Images or templates cannot be compared, or persons not identified."""


class ApplicationError(Scan2AlbedoError):
    """Processed faces cannot be relit, swapped, blended or given another's expression."""


class ReflectanceError(Scan2AlbedoError):
    """Photographs, reflectances or a morphable reflectance model cannot be used."""


class BatchError(Scan2AlbedoError):
    """Many scans cannot be processed as a whole: the manifest, the folder or the cluster is at fault."""


class OutputError(Scan2AlbedoError):
    """Results cannot be written."""


class MissingDependencyError(Scan2AlbedoError):
    """A library or a system library is missing; the message holds the command that mends it."""


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Turn an ImportError of the block into a MissingDependencyError that names the extra to install.

    `extra` is one of `project.optional-dependencies` in pyproject.toml.

    >>> with needs_extra("report"):
    ...     import a_missing_library
    Traceback (most recent call last):
        ...
    scan2albedo.errors.MissingDependencyError: No module named 'a_missing_library'; install ...
    """
    try:
        yield
    except ImportError as error:
        raise MissingDependencyError(
            f"{error}; install what this needs with: pip install 'scan2albedo[{extra}]'"
        ) from error


def import_open3d() -> ModuleType:
    """Return open3d, whose import takes seconds; MissingDependencyError without it or what it needs."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise MissingDependencyError(
            f"Open3D cannot be loaded ({error}); run tools/bootstrap_system.sh, or install open3d-cpu and "
            "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1"
        ) from error
    return open3d


@contextmanager
def errors_of(
    owner: str, kind: type[Scan2AlbedoError], *others: type[Exception], advice: str = ""
) -> Iterator[None]:
    """Put the `owner` of an error of the block in front of it, unless it says so, and `advice` behind it.

    Errors of `others` become of the `kind`.
    """
    try:
        yield
    except (kind, *others) as error:
        said = str(error) if owner in str(error) else f"{owner}: {error}"
        raise kind(f"{said}; {advice}" if advice else said) from error


@contextmanager
def memory_errors_of(name: str) -> Iterator[None]:
    """Turn a MemoryError, RecursionError or OverflowError into a TooLargeError that names its scan."""
    try:
        yield
    except MemoryError as error:
        raise TooLargeError(
            f"{name}: needs more memory than there is ({one_line(error)}); give the scan fewer triangles, "
            "its texture fewer pixels, or ask for fewer texels"
        ) from error
    except (RecursionError, OverflowError) as error:
        raise TooLargeError(
            f"{name}: is too deep, or holds too large numbers ({type(error).__name__}: {one_line(error)}); "
            "export the scan again"
        ) from error


def one_line(error: BaseException | str) -> str:
    """Return a message, or what an error says, on one line, printable, and at most 500 characters long.

    An OSError says its reason without the name of its file, which the message around it gives; an error
    without words its kind.
    """
    said = getattr(error, "strerror", None) or str(error)
    if not said and isinstance(error, BaseException):
        said = type(error).__name__
    text = printable(" ".join(said.split()))
    return text if len(text) <= 500 else f"{text[:300]} ... {text[-195:]}"
