import shutil
import sys

import numpy as np
import pytest
from helpers.scan_files import assert_refused, textured_gltf, textured_ply, with_picture_file, write_gltf
from helpers.square import png_bytes, quarters, square_gltf, write_image, write_square_obj

from scan2albedo.core import RawScan
from scan2albedo.errors import ScanError
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.io.load_scan import files_of_scan, load_scan


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


@pytest.mark.parametrize("name", ["no json.gltf", "no json.glb", "alone.glb"])
def test_a_file_that_names_no_others_stands_alone(tmp_path, name):
    (tmp_path / name).write_bytes(square_gltf().data() if name == "alone.glb" else b"no json")
    assert files_of_scan(tmp_path / name) == (tmp_path / name,)


def glb_with_files(folder):
    file = with_picture_file(square_gltf(), "skin.png")
    file.tree["buffers"].append({"uri": "lost.bin", "byteLength": 8})
    return file.write(folder / "face.glb")


def obj_of_several_libraries(folder):
    """Its libraries are named in a line that goes on; one of them names a picture that is missing."""
    path = write_square_obj(folder, change=("mtllib face.mtl", "mtllib other.mtl \\\n  face.mtl"))
    (folder / "other.mtl").write_text("newmtl lips\nmap_Kd lips.png\n")
    return path


def obj_whose_own_texture_is_missing(folder):
    """Of two materials the unused one has its picture; the used one takes that of the scan's name."""
    return write_square_obj(folder, mtl="newmtl skin\nmap_Kd lost.png\nnewmtl lips\nmap_Kd skin.png\n")


def gltf_with_picture_inside(folder):
    return write_gltf(folder / "face.gltf", square_gltf(png_bytes(quarters())))


def outcome(path):
    """Return what is read of a scan, as text; or the error."""
    try:
        scan = load_scan(path, "mm")
    except ScanError as error:
        return str(error)
    texture = None if scan.texture_linear is None else scan.texture_linear.tobytes()
    return repr((scan.vertices.tolist(), scan.uv, texture, scan.notes))


MADE = [
    write_square_obj,
    obj_of_several_libraries,
    obj_whose_own_texture_is_missing,
    lambda folder: textured_ply(folder, "skin.png"),
    lambda folder: textured_gltf(folder, "skin.png"),
    glb_with_files,
    gltf_with_picture_inside,
]
"""What writes a scan into a folder that holds skin.png."""


@pytest.fixture
def folder(tmp_path):
    write_image(tmp_path / "skin.png", quarters())
    return tmp_path


@pytest.mark.parametrize("made", MADE)
def test_no_file_that_changes_what_is_read_is_left_out_of_the_hash(folder, made):
    path = made(folder)
    before, read, counted = input_sha256(path), outcome(path), set()
    for file in sorted(folder.iterdir()):
        content = file.read_bytes()
        file.write_bytes(b"")
        if outcome(path) != read:
            assert input_sha256(path) != before, file.name
            counted.add(file)
        file.write_bytes(content)
    assert len(counted) > 1
    assert counted <= set(files_of_scan(path))


def test_a_file_that_is_not_hashed_is_not_read(folder, monkeypatch):
    module = sys.modules["scan2albedo.io.load_scan"]
    monkeypatch.setattr(module, "files_of_scan", lambda path, textures: (path,))
    assert_refused(gltf_with_picture_inside(folder), "refers to a missing file")
    for made in (MADE[0], MADE[3], MADE[5]):
        assert load_scan(made(folder), "mm").texture_linear is None


def test_scans_in_memory_are_hashed_by_value():
    faces = [[0, 1, 2]]
    scan = RawScan(np.eye(3), faces)
    assert input_sha256(scan) == input_sha256(RawScan(np.eye(3), faces, name="other"))
    for other in (
        RawScan(np.eye(3), [[0, 2, 1]]),
        RawScan(np.eye(3), faces, vertex_color_linear=np.eye(3)),
    ):
        assert input_sha256(scan) != input_sha256(other)
    assert len(input_sha256(scan)) == 64


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ScanError, match=r"lost\.obj: cannot be read: No such file"):
        input_sha256(tmp_path / "lost.obj")
