"""What is missing on this machine, and the command that mends it."""

import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from tempfile import TemporaryDirectory

SYSTEM_LIBRARIES = "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1"
"""Debian packages that Open3D's wheel needs and slim machines lack."""
IMPORT_NAMES = {
    "dask": "distributed",
    "Jinja2": "jinja2",
    "libigl": "igl",
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "scikit-image": "skimage",
}
"""Names by which libraries are imported, where these are not the packages' names."""
DEVELOPERS = ("test", "docs", "dev", "peers")
"""Extras that no command needs."""


@dataclass(frozen=True)
class Finding:
    """The result of one check: the version found, or the error and its remedy; extras may be missing."""

    subject: str
    good: bool
    detail: str
    remedy: str = ""


def compile_kernels() -> None:
    """Process a synthetic scan with every output: numba keeps what it compiles where the package lies."""
    from scan2albedo.pipeline.process import process
    from scan2albedo.synthetic import raw_scan

    with TemporaryDirectory() as folder:
        process(raw_scan(0)[0], folder, unlit="all", maps="chart")


def libraries(requirements: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return requirement and extra of each package that commands need; "" is what all need."""
    found: dict[str, tuple[str, str]] = {}
    for line in requirements:
        requirement, _, marker = line.partition(";")
        extra = re.search(r"extra == ['\"](\w+)", marker)
        name = re.split(r"[^\w.-]", requirement)[0].removesuffix("-cpu")
        if name != "scan2albedo" and not (extra and extra[1] in DEVELOPERS):
            found.setdefault(name, (requirement.strip(), extra[1] if extra else ""))
    return found


def examine() -> Iterator[Finding]:
    """Yield a finding for Python, each library (really imported, in a process of its own) and the model."""
    yield Finding("Python", True, ".".join(map(str, sys.version_info[:3])))
    for package, (requirement, extra) in libraries(requires("scan2albedo") or ()).items():
        yield examined_library(package, requirement, extra)
    from scan2albedo.errors import ModelError
    from scan2albedo.templates import AnnotatedFaceModel

    try:
        model = AnnotatedFaceModel.default()
    except (ImportError, ModelError) as error:
        remedy = f"{sys.executable} -m pip install --force-reinstall ."
        yield Finding("default face model", False, str(error), remedy)
    else:
        yield Finding("default face model", True, f"{len(model.control_vertices)} control vertices")


def examined_library(package: str, requirement: str, extra: str = "") -> Finding:
    """Return whether a package is installed and can be imported."""
    install = f"{sys.executable} -m pip install"
    installed = None
    for name in (f"{package}-cpu", package):
        with suppress(PackageNotFoundError):
            installed = version(name)
    if installed is None and extra:
        detail = f"not installed, and needed by the extra [{extra}] alone"
        return Finding(package, True, detail, f"{install} 'scan2albedo[{extra}]'")
    if installed is None:
        return Finding(package, False, "not installed", f"{install} '{requirement}'")
    # A library that lacks a system library may crash instead of raising, so it is tried in its own process.
    module = IMPORT_NAMES.get(package, package)
    attempt = subprocess.run(
        [sys.executable, "-c", f"import {module}"], capture_output=True, text=True, check=False, timeout=300
    )
    if attempt.returncode == 0:
        return Finding(package, True, installed)
    complaint = (attempt.stderr.strip().splitlines() or [f"exit status {attempt.returncode}"])[-1]
    remedy = f"{install} --force-reinstall '{requirement}'"
    if package == "open3d" or ".so" in complaint:
        remedy = f"apt-get install -y {SYSTEM_LIBRARIES}    (or: tools/bootstrap_system.sh)"
    return Finding(package, False, f"{installed} does not import: {complaint}", remedy)
