"""Pictures of anyone's scan."""

import sys

import make_gallery
import numpy as np
import pytest
import trimesh
from PIL import Image


@pytest.mark.slow
def test_a_scan_is_shown_beside_itself_without_its_light(coarse_scan, tmp_path, monkeypatch):
    scan = coarse_scan[0]
    # One colour alone would count as none.
    grain = np.random.default_rng(0).integers(-8, 9, (len(scan.vertices), 1))
    color = (np.array([180, 150, 150]) + grain).astype(np.uint8)
    mesh = trimesh.Trimesh(scan.vertices, scan.faces, vertex_colors=color, process=False)
    mesh.export(tmp_path / "subject.ply")
    monkeypatch.setattr(
        sys, "argv", ["make_gallery", "--scan", str(tmp_path / "subject.ply"), "-o", str(tmp_path / "out")]
    )
    make_gallery.main()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"scan.jpg", "unlit.jpg", "maps.jpg"}
    with Image.open(tmp_path / "out" / "unlit.jpg") as picture:
        pixels = np.asarray(picture.convert("RGB"), float)
    # Four panels, each with a face on white.
    for panel in np.array_split(pixels[: make_gallery.HEIGHT], 4, axis=1):
        assert 0.2 < (panel.min(-1) < 240).mean() < 0.95
