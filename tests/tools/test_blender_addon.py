"""The add-on in Blender's own Python module: a scan in, an object with its material and its lights out."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from scan2albedo.synthetic import Scanner, raw_scan

ROOT = Path(__file__).resolve().parents[2]
BLENDER = os.environ.get("SCAN2ALBEDO_BLENDER_PYTHON", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not BLENDER, reason="SCAN2ALBEDO_BLENDER_PYTHON names no Python with bpy (pip install bpy)"
    ),
]


def test_a_scan_becomes_an_object_with_its_material_and_lights(tmp_path):
    from worlds.files import write_obj

    scan, _ = raw_scan(0, scanner=Scanner(size=128, picture_size=500, spacing_mm=3.0))
    write_obj(scan, tmp_path / "person.obj")
    command = Path(sys.executable).with_name("scan2albedo")
    check = ROOT / "tools" / "blender" / "check_addon.py"
    words = [BLENDER, check, "person.obj", tmp_path / "out", command]
    done = subprocess.run(
        [str(word) for word in words], cwd=tmp_path, capture_output=True, text=True, timeout=600
    )
    assert "all of it held" in done.stdout, done.stdout[-2000:] + done.stderr[-2000:]
