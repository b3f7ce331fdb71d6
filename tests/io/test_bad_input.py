"""Whatever is handed to `load_scan`, the answer is a scan or one `ScanError` that names the file."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.meshes import obj_text
from helpers.square import png_bytes, quarters, square_gltf, write_square_obj

from scan2albedo.core import RawScan
from scan2albedo.errors import ScanError
from scan2albedo.io import load_scan
from scan2albedo.io.load_scan import SUPPORTED_SCANS

SPHERE = trimesh.creation.icosphere(subdivisions=1, radius=80.0)


@pytest.mark.parametrize("extension", SUPPORTED_SCANS)
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "cannot be read: No such file.*check the path"),
        (Path.touch, r"the file is empty \(0 bytes\)"),
        (Path.mkdir, "is a folder; name the scan file in it, or run `scan2albedo batch"),
        (lambda path: path.write_bytes(np.random.default_rng(0).bytes(4000)), ""),
    ],
)
def test_what_is_no_file_of_its_kind_is_named(tmp_path, make, message, extension):
    path = tmp_path / f"a{extension}"
    make(path)
    with pytest.raises(ScanError, match=rf"a\{extension}: {message}"):
        load_scan(path)


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.glb", "a.stl", "a.off", "a.zip", "a"])
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "a Git LFS pointer"),
        (b"\n\n<!DOCTYPE html>\n<html></html>", "a web page: download the file itself"),
        (b"PK\x03\x04" + bytes(40), "an archive: unpack it"),
        (b"\x1f\x8b\x08" + bytes(40), "an archive: unpack it"),
        (b"#VRML V2.0 utf8\n", "a VRML scene: export the scan as"),
    ],
)
def test_what_is_no_scan_is_named_by_its_beginning(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ScanError, match=rf"{name}: is {message}"):
        load_scan(tmp_path / name)


def test_a_texture_that_is_a_pointer_is_named(tmp_path):
    path = write_square_obj(tmp_path)
    (tmp_path / "face.png").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    assert any("face.png: is a Git LFS pointer" in note for note in load_scan(path).notes)


@pytest.mark.parametrize("name", ["a.fbx", "a", "a.obj.txt"])
def test_unsupported_kinds_list_the_supported_ones(tmp_path, name):
    (tmp_path / name).write_text("v 0 0 0")
    with pytest.raises(
        ScanError, match=rf"{name}: .* not supported; .*\.obj, \.ply, \.glb, \.gltf, \.stl, \.off"
    ):
        load_scan(tmp_path / name)


WHOLE = {
    "a.obj": obj_text(SPHERE.vertices, SPHERE.faces).encode(),
    "a.ply": SPHERE.export(file_type="ply"),
    "b.ply": SPHERE.export(file_type="ply", encoding="ascii"),
    "a.stl": SPHERE.export(file_type="stl"),
    "b.stl": SPHERE.export(file_type="stl_ascii").encode(),
    "a.off": SPHERE.export(file_type="off").encode(),
    "a.glb": square_gltf(png_bytes(quarters())).data(),
}


@pytest.mark.parametrize("name", sorted(WHOLE))
def test_damaged_bytes_give_a_scan_or_a_clear_error(tmp_path, name):
    rng = np.random.default_rng(11)
    for trial in range(60):
        data = bytearray(WHOLE[name])
        for _ in range(rng.integers(1, 5)):
            data[rng.integers(len(data))] = rng.integers(256)
        if trial % 3 == 0:
            start = int(rng.integers(len(data)))
            del data[start : start + int(rng.integers(1, 200))]
        (tmp_path / name).write_bytes(data)
        try:
            load_scan(tmp_path / name, unit="mm")
        except ScanError as error:
            said = str(error)
            assert said.count(name) == 1
            assert "\n" not in said
            assert not re.search(r"\w+Error:", said)


CLOUD = trimesh.PointCloud(SPHERE.vertices)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.obj", obj_text(SPHERE.vertices).encode()),
        ("a.ply", CLOUD.export(file_type="ply")),
        ("b.ply", CLOUD.export(file_type="ply", encoding="ascii")),
        ("a.off", b"OFF\n2 0 0\n0 0 0\n1 1 1\n"),
    ],
)
def test_a_point_cloud_and_a_text_without_any_geometry(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ScanError, match=rf"{name}: holds a point cloud of \d+ vertices; a surface is needed"):
        load_scan(tmp_path / name)
    (tmp_path / "a.obj").write_text("this is a letter, not a mesh\n")
    with pytest.raises(ScanError, match=r"a\.obj: holds no vertices and no faces"):
        load_scan(tmp_path / "a.obj")


def test_five_vertices_are_a_scan_here(tmp_path):
    rows = ["v 0 0 0", "v 100 0 0", "v 100 100 0", "v 0 100 0", "v 50 50 80"]
    (tmp_path / "a.obj").write_text("\n".join([*rows, "f 1 2 5", "f 2 3 5", "f 3 4 5", "f 4 1 5"]))
    assert load_scan(tmp_path / "a.obj").vertices.shape == (5, 3)


def test_names_with_spaces_and_letters_of_other_scripts(tmp_path):
    path = tmp_path / "Gesicht von Jürgen 顔.ply"
    path.write_bytes(WHOLE["a.ply"])
    assert load_scan(str(path)).name == "Gesicht von Jürgen 顔"
    assert load_scan(path, name="subject 1").name == "subject 1"


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.eye(3), [[0, 1, -1]], "a face refers to vertex -1, but there are 3"),
        (np.eye(3)[:, :2], [[0, 1, 2]], r"vertices has shape \(3, 2\), expected \(any, 3\)"),
        (np.eye(3), np.zeros((0, 3)), r"no faces \(3 vertices\)"),
    ],
)
def test_raw_scans_from_memory_are_checked(vertices, faces, message):
    with pytest.raises(ScanError, match=f"me: {message}"):
        RawScan(vertices, faces, name="me")


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "..\\up"])
def test_a_name_that_names_no_folder_is_refused(name):
    with pytest.raises(ScanError, match="a scan cannot be named"):
        RawScan(np.eye(3), [[0, 1, 2]], name=name)
