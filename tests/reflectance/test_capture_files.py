"""Captures as files: what is written is read again, and what is wrong is named."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from scan2albedo.errors import ReflectanceError, ScanError
from scan2albedo.geometry.pinhole import camera_centers
from scan2albedo.reflectance import read_capture
from scan2albedo.runs.reflectance.capture_run import fit_capture
from scan2albedo.runs.reflectance.demo import write_synthetic_capture
from scan2albedo.synthetic import Portrait, flash_capture


@pytest.fixture(scope="module")
def capture():
    return flash_capture(4, views=2, flashes=3, levels=1, portrait=Portrait(picture_size=64))


@pytest.fixture(scope="module")
def written(capture, tmp_path_factory):
    return write_synthetic_capture(capture, tmp_path_factory.mktemp("capture"))


def test_what_is_written_is_read_again(capture, written):
    read = read_capture(written)
    assert np.allclose(read.rig.cameras, capture.cameras, atol=1e-9)
    assert np.allclose(read.rig.light_positions, capture.light_positions[capture.light])
    assert np.allclose(read.vertices, capture.vertices, atol=1e-4)
    assert (read.faces == capture.faces).all()
    assert read.reference_distance_mm == capture.portrait.distance_mm
    assert read.content.flash_strength == capture.exposure
    assert read.scale_known
    olat = read.extract_olat()
    assert olat.linear.shape == (6, 64, 64, 3)
    assert not olat.valid[~capture.skin].any()
    assert olat.valid[capture.skin].mean() > 0.9


def test_unit_of_the_file_is_that_of_mesh_poses_and_falloff(changed, capture):
    read = read_capture(changed(lambda content: content.update(unit="cm")))
    assert np.allclose(read.vertices, 10 * capture.vertices, atol=1e-3)
    assert np.allclose(read.rig.camera_positions, 10 * camera_centers(capture.cameras), atol=1e-6)
    assert read.reference_distance_mm == pytest.approx(10_000)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: c.pop("mesh"), "mesh: Field required"),
        (lambda c: c.update(gamma=-1), "gamma"),
        (lambda c: c["pictures"][2].update(flash="moon"), "pictures.2: its flash 'moon' is no pose"),
        (lambda c: c["poses"][1].update(name="place_00"), "two poses have one name"),
        (lambda c: c.update(intrinsics=None), "'place_00' has no intrinsics"),
        (lambda c: c["poses"][0].update(rotation=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "rotation"),
        (lambda c: c.update(pictures=[]), "pictures"),
        (lambda c: c.update(lens="wide"), "lens"),
        (lambda c: c.update(saturation=1e9), "saturation: Input should be less than or equal to 1000000"),
        (lambda c: c.update(mesh="../face.ply"), r"\.\./face\.ply lies outside its folder; copy it there"),
        (lambda c: c.update(mesh="a\0.ply"), r"lies outside its folder"),
    ],
)
def test_files_that_do_not_fit_are_refused_by_name(changed, change, told):
    file = changed(change)
    with pytest.raises(ReflectanceError, match=told) as raised:
        read_capture(file)
    assert "capture.json" in str(raised.value)


def test_missing_mesh_and_picture_are_named(folder):
    (folder / "flash_01_02.png").unlink()
    with pytest.raises(ScanError, match=r"flash_01_02\.png"):
        read_capture(folder / "capture.json").extract_olat()
    (folder / "face.ply").unlink()
    with pytest.raises(ScanError, match=r"face\.ply"):
        read_capture(folder / "capture.json")


def test_pictures_outside_the_folder_are_not_read(folder, changed):
    outside = folder.parent / "outside.png"
    outside.write_bytes((folder / "room_01.png").read_bytes())
    (folder / "link.png").symlink_to(outside)
    inside = json.loads((folder / "capture.json").read_text())["pictures"][0]
    for key in ("room_image", "flash_image"):
        for name in (str(outside), "../outside.png", "link.png"):
            picture = {**inside, key: name}
            capture = read_capture(changed(lambda c, p=picture: c["pictures"][0].update(p)))
            with pytest.raises(ReflectanceError, match=rf"capture\.json: .*{name} lies outside its folder"):
                capture.extract_olat()


@pytest.mark.parametrize("name", ["room_01.png", "flash_00_01.png", "skin_01.png"])
def test_pictures_of_another_size_are_named(folder, name):
    cv2.imwrite(str(folder / name), np.full((10, 20, 3), 90, np.uint8))
    with pytest.raises(ReflectanceError, match=f"{name} is 20 x 10 pixels"):
        read_capture(folder / "capture.json").extract_olat()


def test_pictures_without_integers_cannot_be_written(capture, tmp_path):
    floats = replace(capture, portrait=replace(capture.portrait, bits=None))
    with pytest.raises(ValueError, match="bits"):
        write_synthetic_capture(floats, tmp_path)


def test_the_example_of_the_documentation(tmp_path):
    page = Path(__file__).resolve().parents[2] / "docs" / "capture_format.md"
    example = re.search(r"^```json\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    (tmp_path / "capture.json").write_text(example.group(1))
    trimesh.creation.icosphere(radius=80).export(tmp_path / "face.ply")
    value = np.full((768, 1024, 3), 40, np.uint8)
    cv2.imwrite(str(tmp_path / "front_room.png"), value)
    cv2.imwrite(str(tmp_path / "front_side.png"), value + 90)
    read = read_capture(tmp_path / "capture.json")
    assert np.allclose(read.rig.camera_positions, [[0, 0, 1000]])
    assert np.allclose(read.rig.light_positions, [[1000, 0, 0]])
    light = (130 / 255) ** 2.2 - (40 / 255) ** 2.2
    assert read.extract_olat().linear[0, 300, 500] == pytest.approx(light, rel=1e-5)
    assert "gamma" in read.content.model_fields_set
    assert not read.scale_known


def notes(file, words):
    """Return those of the notes on a fit that hold some words."""
    found = fit_capture(read_capture(file), held_out_every=0).notes
    return [note for note in found if words in note]


def test_what_may_be_wrong_is_told(written, changed):
    assert not any("gamma" in note or "long" in note for note in notes(written, ""))
    (note,) = notes(changed(lambda content: content.pop("gamma")), "gives no gamma")
    assert "value^1.2" in note
    (note,) = notes(changed(lambda content: content.update(gamma=2.6)), "wrong gamma")
    assert re.match(r"residuals are 1\.[5-9] times the noise", note)
    assert note.endswith("(light is taken as value^2.6)")
    (note,) = notes(changed(lambda content: content.update(unit="cm")), "long")
    assert re.match(r"face\.ply is \d+ cm long, and a head measures 80 to 800 mm: .* \"unit\": \"mm\"", note)
