"""The examples run as they are, on synthetic data, and write what they say."""

import ast
import runpy
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import scan2albedo
from scan2albedo.applications import load_result
from scan2albedo.recognition import read_templates
from scan2albedo.reflectance import read_reflectance

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run(name, out, *arguments):
    runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](["-o", str(out), *map(str, arguments)])
    return out


def size_of(path):
    with Image.open(path) as picture:
        return picture.size


def test_a_raw_scan_is_processed(coarse_scan, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(scan2albedo.synthetic, "raw_scan", lambda seed: coarse_scan)
    folder = run("process_scan", tmp_path, "--size", 64) / "synthetic-0"
    assert load_result(folder).image.shape == (64, 64)
    assert (folder / "overview.png").is_file()
    assert "nose tip at" in capsys.readouterr().out


def test_a_face_is_relit(tmp_path):
    run("relight_sweep", tmp_path, "--frames", 2, "--size", 48)
    assert size_of(tmp_path / "portrait.png") == size_of(tmp_path / "sky.png") == (48, 48)
    with Image.open(tmp_path / "sweep.gif") as animation:
        assert animation.n_frames == 2
    assert len(list((tmp_path / "frames").glob("frame_*.png"))) == 2
    # The sun of the sky stands to the subject's left.
    sky = np.asarray(Image.open(tmp_path / "sky.png"), float)
    face = sky.min(-1) < 250
    assert sky[:, 24:][face[:, 24:]].mean() > 1.2 * sky[:, :24][face[:, :24]].mean()


@pytest.mark.slow
def test_faces_are_swapped_and_blended(tmp_path):
    run("swap_and_blend", tmp_path, "--size", 48)
    assert size_of(tmp_path / "swaps.png") == (4 * 48, 48)
    assert size_of(tmp_path / "blends.png") == (5 * 48, 48)
    assert load_result(tmp_path / "middle").name == "person-0+person-1"
    again = run("swap_and_blend", tmp_path / "again", "--size", 32, tmp_path / "middle", tmp_path / "middle")
    assert (again / "middle" / "application.json").is_file()


def test_a_smile_is_transferred(tmp_path, capsys):
    run("transfer_expression", tmp_path, "--size", 48)
    assert size_of(tmp_path / "expressions.png") == (5 * 48, 48)
    assert len(trimesh.load(tmp_path / "smiling.glb", force="mesh", process=False).faces) > 1000
    moved = float(capsys.readouterr().out.split("up to ")[1].split()[0])
    assert 2 < moved < 20


@pytest.mark.slow
def test_persons_are_identified(tmp_path, capsys):
    run("identify_gallery", tmp_path, "--persons", 2, "--size", 48)
    assert read_templates(tmp_path / "gallery.npz").names == ("person-0", "person-1")
    assert "by albedo: 100% right at rank 1" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["swap_and_blend", "transfer_expression"])
def test_a_wrong_number_of_results_is_a_usage_error(name, tmp_path):
    with pytest.raises(SystemExit, match="2"):
        run(name, tmp_path / "out", tmp_path)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_examples_stand_on_public_names(path):
    """From the package itself and its subpackages, not from modules within them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    ours = {module for module in modules if module.startswith("scan2albedo")}
    assert all(module.count(".") <= 1 for module in ours), ours
    assert f'run("{path.stem}"' in Path(__file__).read_text(encoding="utf-8")


def test_reflectance_is_found_from_flashes(tmp_path, capsys):
    run("reflectance_from_flashes", tmp_path)
    assert read_reflectance(tmp_path / "reflectance.npz").reflectance.known.sum() > 2500
    assert "vertices known" in capsys.readouterr().out
    one, other = (trimesh.load(tmp_path / f"lamp_{k}.ply", process=False) for k in (0, 2))
    left = one.vertices[:, 0] < -30
    brightness = [mesh.visual.vertex_colors[:, :3].mean(1) for mesh in (one, other)]
    assert brightness[0][left].mean() > 2 * brightness[1][left].mean()
