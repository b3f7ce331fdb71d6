"""A scan's materials and textures come from its own folder, and from one more where the user says so."""

import shutil

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import succeeded
from helpers.records import read_json
from helpers.scan_files import assert_refused, textured_gltf, textured_ply
from helpers.square import quarters, write_image, write_square_obj

from scan2albedo import load_scan
from scan2albedo.batch.manifest import read_manifest
from scan2albedo.errors import ScanError
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.io.load_scan import READERS, files_of_scan
from scan2albedo.io.parsed_mesh import ParsedMesh, ScanFolder

OUTSIDE = "lies outside the scan's folder, and only --textures"


def obj(folder, texture):
    path = write_square_obj(folder, mtl=f"newmtl skin\nmap_Kd {texture}\n")
    (folder / "face.png").unlink()
    return path


@pytest.fixture
def places(tmp_path):
    """The scan's folder, and another with a texture."""
    scan, other = tmp_path / "scan", tmp_path / "other"
    for folder in (other, other / "deep"):
        folder.mkdir()
        write_image(folder / "secret.png", quarters())
    scan.mkdir()
    return scan, other


@pytest.mark.parametrize("written", [obj, textured_ply, textured_gltf])
@pytest.mark.parametrize("way", ["absolute", "upward", "a link", "a linked folder"])
def test_a_texture_elsewhere_is_not_read_unless_its_folder_is_given(places, written, way):
    scan, other = places
    named = {"absolute": f"{other}/secret.png", "upward": "../other/secret.png", "a link": "linked.png"}
    path = written(scan, named.get(way, "linked/secret.png"))
    (scan / "linked.png").symlink_to(other / "secret.png")
    (scan / "linked").symlink_to(other)
    loaded = load_scan(path)
    assert loaded.texture_linear is None
    assert any(OUTSIDE in note or "is missing, damaged" in note for note in loaded.notes)
    assert not [file for file in files_of_scan(path) if file.suffix == ".png"]
    allowed = load_scan(path, textures=other)
    assert allowed.texture_linear.shape == (8, 8, 3)
    assert files_of_scan(path, other)[-1].suffix == ".png"
    assert input_sha256(path) != input_sha256(path, other)
    assert load_scan(path, textures=other / "deep").texture_linear is not None or way.startswith("a link")


@pytest.mark.parametrize("name", ["../other/face.mtl", "linked.mtl"])
def test_a_material_library_elsewhere_is_not_read_either(places, name):
    scan, other = places
    path = write_square_obj(scan, texture="skin.png", change=("face.mtl", name))
    shutil.move(scan / "face.mtl", other / "face.mtl")
    (scan / "linked.mtl").symlink_to(other / "face.mtl")
    loaded = load_scan(path)
    assert loaded.texture_linear is None
    assert any(f"material library {name} {OUTSIDE}" in note for note in loaded.notes)
    assert load_scan(path, textures=other).texture_linear is not None


def test_links_inside_the_folder_and_a_folder_that_is_a_link_are_no_fault(places):
    scan, other = places
    path = obj(scan, "linked.png")
    write_image(scan / "face1.png", quarters())
    (scan / "linked.png").symlink_to("face1.png")
    (other / "scan").symlink_to(scan)
    for file in (path, other / "scan" / path.name):
        assert load_scan(file).texture_linear is not None


def test_a_folder_of_textures_that_is_none_is_named(places):
    scan, other = places
    path = obj(scan, "secret.png")
    with pytest.raises(ScanError, match=r"secret\.png: is not a folder"):
        load_scan(path, textures=other / "secret.png")
    assert load_scan(path, textures=str(other)).texture_linear is not None


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "..", "", "/", "C:\\", "/dev/zero", "../" * 2000 + "x"])
def test_names_that_no_file_has_find_nothing(places, name):
    assert ScanFolder(places[0]).find(name) is None
    assert ScanFolder(places[0]).why_missing(name).startswith("is missing beside the scan (--textures ")


@pytest.mark.slow
def test_the_command_takes_the_folder(places, tmp_path):
    scan, other = places
    path, out = obj(scan, "../other/secret.png"), tmp_path / "out"
    arguments = ["process", path, "-o", out, "--model", "none", "--size", 32, "--no-pictures"]
    arguments += ["--quality", "draft", "--lights", 1]
    assert OUTSIDE not in succeeded(invoke(*arguments, "--textures", other)).stderr
    assert (out / "face" / "albedo.exr").exists()
    record = read_json(out / "face" / "result.json")
    assert record["options"]["textures"] == str(other)
    assert record["input"]["sha256"] == input_sha256(path, other)


def test_a_reader_that_is_added_is_honoured_everywhere(tmp_path, monkeypatch):
    def read_points(path, folder):
        return ParsedMesh(np.loadtxt(path), np.array([[0, 1, 2]]))

    monkeypatch.setitem(READERS, ".xyz", read_points)
    (tmp_path / "face.XYZ").write_text("0 0 0\n150 0 0\n0 150 0\n")
    assert load_scan(tmp_path / "face.XYZ").vertices.shape == (3, 3)
    assert [scan.name for scan in read_manifest(tmp_path).scans] == ["face"]
    (tmp_path / "face.abc").touch()
    assert_refused(tmp_path / "face.abc", r"save the scan as one of .*\.xyz")
