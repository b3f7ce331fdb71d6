"""The add-on in Blender's own Python module: a scan in, an object with its material and its lights out."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BLENDER = os.environ.get("SCAN2ALBEDO_BLENDER_PYTHON", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not BLENDER, reason="SCAN2ALBEDO_BLENDER_PYTHON names no Python with bpy (pip install bpy)"
    ),
]


def test_a_scan_becomes_an_object_with_its_material_and_lights(coarse_scan, tmp_path):
    from worlds.files import write_obj

    write_obj(coarse_scan[0], tmp_path / "person.obj")
    command = Path(sys.executable).with_name("scan2albedo")
    check = ROOT / "tools" / "blender" / "check_addon.py"
    words = [BLENDER, check, "person.obj", tmp_path / "out", command]
    done = subprocess.run(
        [str(word) for word in words], cwd=tmp_path, capture_output=True, text=True, timeout=600
    )
    assert "all of it held" in done.stdout, done.stdout[-2000:] + done.stderr[-2000:]
