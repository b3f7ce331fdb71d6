"""The wheel alone, without the repository beside it, processes a scan."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = """
import sys
from pathlib import Path

import scan2albedo as s2a
from scan2albedo.synthetic import Scanner, raw_scan

assert Path(s2a.__file__).is_relative_to(sys.argv[1]), s2a.__file__
scan, _ = raw_scan(0, scanner=Scanner(size=64, picture_size=300, spacing_mm=4.0))
result = s2a.process(scan, out="out", size=64, quality="draft")
assert result.fitted is not None
assert result.albedo is not None
print("processed", result.out.name)
"""


def run(*words, cwd, **more):
    done = subprocess.run(
        [str(word) for word in words], cwd=cwd, capture_output=True, text=True, timeout=600, **more
    )
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-1500:]
    return done.stdout


@pytest.mark.slow
def test_the_wheel_holds_the_package_alone_and_processes_a_scan(tmp_path):
    source, target = tmp_path / "source", tmp_path / "installed"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(
        ROOT / "scan2albedo", source / "scan2albedo", ignore=shutil.ignore_patterns("__pycache__")
    )
    pip = sys.executable, "-m", "pip", "--disable-pip-version-check"
    run(*pip, "wheel", "--quiet", "--no-deps", "-w", tmp_path, source, cwd=tmp_path)
    (wheel,) = tmp_path.glob("scan2albedo-*.whl")
    held = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].partition("-")[0] for name in held} == {"scan2albedo"}
    copied = (source / "scan2albedo").rglob("*.*")
    assert {file.relative_to(source).as_posix() for file in copied} <= set(held)
    assert any(name.endswith("/NOTICE") for name in held)
    assert wheel.stat().st_size < 5e6
    run(*pip, "install", "--quiet", "--no-deps", "--target", target, wheel, cwd=tmp_path)
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "PYTHONPATH": str(target)}
    # -P keeps the current folder off the path, where a checkout might lie.
    said = run(sys.executable, "-P", "-c", SCRIPT, target, cwd=tmp_path, env=environment)
    assert "processed" in said
