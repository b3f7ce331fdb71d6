"""Whatever is handed to `load_scan`, the answer is a scan or one `ScanError` that names the file."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.meshes import obj_text
from helpers.scan_files import assert_refused
from helpers.square import png_bytes, quarters, square_gltf

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
    assert_refused(path, rf"a\{extension}: {message}")


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
    assert_refused(tmp_path / name, rf"{name}: is {message}")


@pytest.mark.parametrize("name", ["a.fbx", "a", "a.obj.txt"])
def test_unsupported_kinds_list_the_supported_ones(tmp_path, name):
    (tmp_path / name).write_text("v 0 0 0")
    assert_refused(tmp_path / name, rf"{name}: .* not supported; .*\.obj, \.ply, \.glb, \.gltf, \.stl, \.off")


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


@pytest.mark.parametrize("name", sorted(WHOLE.keys() - {"a.obj"}))
@pytest.mark.parametrize("part", [0.001, 0.1, 0.3, 0.62, 0.97])
def test_truncated_files_are_refused_by_name(tmp_path, name, part):
    data = WHOLE[name]
    (tmp_path / name).write_bytes(data[: int(len(data) * part)])
    assert_refused(tmp_path / name, rf"{name}: .*(truncated|point cloud|empty)")


CLOUD = trimesh.PointCloud(SPHERE.vertices)


@pytest.mark.parametrize(
    ("name", "data", "holds"),
    [
        ("a.obj", obj_text(SPHERE.vertices).encode(), "a point cloud of 42 vertices"),
        ("a.ply", CLOUD.export(file_type="ply"), "a point cloud of 42 vertices"),
        ("b.ply", CLOUD.export(file_type="ply", encoding="ascii"), "a point cloud of 42 vertices"),
        ("a.off", b"OFF\n2 0 0\n0 0 0\n1 1 1\n", "a point cloud of 2 vertices"),
        ("a.obj", b"this is a letter, not a mesh\n", "no vertices and no faces"),
    ],
)
def test_a_point_cloud_and_a_text_without_any_geometry(tmp_path, name, data, holds):
    (tmp_path / name).write_bytes(data)
    assert_refused(tmp_path / name, f"{name}: holds {holds}; a surface is needed")


def test_names_with_spaces_and_letters_of_other_scripts(tmp_path):
    path = tmp_path / "Gesicht von Jürgen 顔.ply"
    path.write_bytes(WHOLE["a.ply"])
    assert load_scan(str(path)).name == "Gesicht von Jürgen 顔"
    assert load_scan(path, name="subject 1").name == "subject 1"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"faces": [[0, 1, -1]]}, "scan: a face refers to vertex -1, but there are 3"),
        ({"vertices": np.eye(3)[:, :2]}, r"scan: vertices has shape \(3, 2\), expected \(any, 3\)"),
        ({"faces": np.zeros((0, 3))}, r"scan: no faces \(3 vertices\)"),
        *(({"name": name}, "a scan cannot be named") for name in ("", ".", "..", "a/b", "..\\up")),
    ],
)
def test_raw_scans_from_memory_are_checked(change, message):
    with pytest.raises(ScanError, match=message):
        RawScan(**{"vertices": np.eye(3), "faces": [[0, 1, 2]]} | change)
