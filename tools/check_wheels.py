"""For which systems and Pythons every dependency has a wheel, as pip finds them.

usage: python tools/check_wheels.py

Prints a line for each system and Python: the dependencies without a wheel there. Takes two minutes;
nothing is installed.
"""

import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
LINUX = ("2_17", "2_28", "2_31", "2_35")
MACS = [f"macosx_{version}_0" for version in (11, 12, 13, 14, 15)]
SYSTEMS = {
    "Linux x86-64": ("open3d-cpu", [f"manylinux_{glibc}_x86_64" for glibc in LINUX]),
    "Linux ARM": ("open3d", [f"manylinux_{glibc}_aarch64" for glibc in LINUX]),
    "macOS ARM": ("open3d", [f"{mac}_{kind}" for mac in MACS for kind in ("arm64", "universal2")]),
    "macOS Intel": ("open3d", [f"{mac}_{kind}" for mac in MACS for kind in ("x86_64", "universal2")]),
    "Windows x86-64": ("open3d", ["win_amd64"]),
}


def main() -> None:
    """Print what is missing."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = [entry.partition(">")[0] for entry in project["dependencies"] if not entry.startswith("open3d")]
    for system, (open3d, platforms) in SYSTEMS.items():
        for python in PYTHONS:
            missing = [name for name in (*names, open3d) if not has_wheel(name, python, platforms)]
            print(f"{system:16}{python:6}{', '.join(missing) or 'all there'}", flush=True)


def has_wheel(name: str, python: str, platforms: list[str]) -> bool:
    """Return whether pip finds a wheel of a package."""
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--no-deps"]
    words += ["--only-binary=:all:", "--implementation", "cp", "--python-version", python]
    words += [word for platform in platforms for word in ("--platform", platform)]
    with tempfile.TemporaryDirectory() as target:
        return subprocess.run([*words, "--target", target, name], capture_output=True).returncode == 0


if __name__ == "__main__":
    main()
