import json
import shutil

import numpy as np
import pytest
from helpers.square import glb_bytes, quarters, square_gltf, write_image, write_square_obj

from scan2albedo.core import RawScan
from scan2albedo.errors import ScanError
from scan2albedo.io.load_scan import files_of_scan, input_sha256


def test_the_hash_follows_the_content_of_all_files_not_their_names(tmp_path):
    path = write_square_obj(tmp_path)
    before = input_sha256(path)
    shutil.copy(path, tmp_path / "copy.obj")
    assert input_sha256(tmp_path / "copy.obj") == before
    assert [p.name for p in files_of_scan(path)] == ["face.obj", "face.mtl", "face.png"]
    write_image(tmp_path / "face.png", quarters()[::-1])
    other = input_sha256(path)
    assert other != before
    (tmp_path / "face.png").unlink()
    assert input_sha256(path) not in (before, other)
    (tmp_path / "face.mtl").unlink()
    write_image(tmp_path / "face.JPG", quarters())  # taken by its name when there is no material
    assert [p.name for p in files_of_scan(path)] == ["face.obj", "face.JPG"]


def test_textures_of_ply_and_gltf_count(tmp_path):
    write_image(tmp_path / "a b.png", quarters())
    (tmp_path / "a.ply").write_bytes(b"ply\nformat ascii 1.0\ncomment TextureFile a b.png\nend_header\n")
    assert [p.name for p in files_of_scan(tmp_path / "a.ply")] == ["a.ply", "a b.png"]
    tree = {"images": [{"uri": "a%20b.png"}, {"uri": "data:,x"}], "buffers": [{"uri": "lost.bin"}]}
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    assert [p.name for p in files_of_scan(tmp_path / "a.gltf")] == ["a.gltf", "a b.png"]
    (tmp_path / "b.gltf").write_text("no json")
    (tmp_path / "a.glb").write_bytes(glb_bytes(*square_gltf(None)))
    for name in ("b.gltf", "a.glb"):
        assert len(files_of_scan(tmp_path / name)) == 1


def test_scans_in_memory_are_hashed_by_value():
    scan = RawScan(np.eye(3), [[0, 1, 2]])
    assert input_sha256(scan) == input_sha256(RawScan(np.eye(3), [[0, 1, 2]], name="other"))
    assert input_sha256(scan) != input_sha256(RawScan(np.eye(3), [[0, 2, 1]]))
    assert input_sha256(scan) != input_sha256(RawScan(np.eye(3), [[0, 1, 2]], vertex_color_linear=np.eye(3)))
    assert len(input_sha256(scan)) == 64


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ScanError, match=r"lost\.obj: cannot be read: No such file"):
        input_sha256(tmp_path / "lost.obj")
