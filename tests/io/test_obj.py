import unicodedata
from unittest import mock

import numpy as np
import pytest
from helpers.meshes import obj_text
from helpers.scan_files import assert_refused, square_of_two_materials
from helpers.square import (
    CORNER_LINEAR,
    SQUARE_MM,
    SQUARE_UV,
    assert_corner_colors,
    color_near_corner,
    quarters,
    write_image,
    write_square_obj,
)
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.io import load_scan, parsed_mesh
from scan2albedo.io.color import srgb_to_linear
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.io.obj import read_obj, write_obj
from scan2albedo.io.parsed_mesh import ScanFolder, parse_mtl


def write(folder, text):
    path = folder / "a.obj"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_positions_coordinates_and_colours_arrive(tmp_path):
    scan = load_scan(write_square_obj(tmp_path))
    assert_array_equal(scan.vertices, SQUARE_MM)
    assert_array_equal(scan.uv, SQUARE_UV[scan.faces])
    assert scan.name == "face"
    assert_corner_colors(scan)


@pytest.mark.parametrize(
    "map_kd",
    [
        "face.png",
        "-s 1 1 1 face.png",
        "-clamp on -o 1 0 face.png",
        '"face.png"',
        "./face.png",
        "C:\\Users\\someone\\Desktop\\FACE.PNG",
        "/home/other/face.png",
        "Face.Png",
    ],
)
def test_textures_are_found_however_they_are_written(tmp_path, map_kd):
    assert_corner_colors(load_scan(write_square_obj(tmp_path, mtl=f"newmtl skin\nmap_Kd {map_kd}\n")))


def test_file_extensions_and_library_in_another_case(tmp_path):
    path = write_square_obj(tmp_path)
    path.rename(tmp_path / "FACE.OBJ")
    (tmp_path / "face.mtl").rename(tmp_path / "Face.MTL")
    assert_corner_colors(load_scan(tmp_path / "FACE.OBJ"))


@pytest.mark.parametrize("texture", ["textures/face.png", "my texture of it.png"])
def test_spaces_in_names_and_a_texture_in_a_subfolder(tmp_path, texture):
    (tmp_path / "textures").mkdir()
    assert_corner_colors(load_scan(write_square_obj(tmp_path, name="my face", texture=texture)))


def test_missing_or_damaged_textures_are_told_and_left_out(tmp_path):
    path, picture = write_square_obj(tmp_path), tmp_path / "face.png"
    write_image(tmp_path / "other.png", quarters())
    for change, said in (
        (lambda: picture.write_text("no image"), "face.png cannot be decoded"),
        (lambda: picture.write_text("version https://git-lfs"), "face.png: is a Git LFS pointer"),
        (picture.unlink, "face.png is missing beside the scan"),
        ((tmp_path / "face.mtl").unlink, "face.mtl is missing beside the scan"),
    ):
        change()
        scan = load_scan(path)
        assert scan.texture_linear is None
        assert any(said in note and "went on without" in note for note in scan.notes)
        assert "no texture or vertex colours: geometry only" in scan.notes


def test_no_mtllib_is_no_fault(tmp_path):
    path = write(tmp_path, "v 0 0 0\nv 100 0 0\nv 0 100 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    scan = load_scan(path)
    assert scan.uv.tolist() == [[[0, 0], [1, 0], [0, 1]]]
    assert not scan.has_color
    write_image(tmp_path / "A.png", quarters())
    scan = load_scan(path)
    assert scan.texture_linear.shape == (8, 8, 3)
    assert "texture A.png was found by the scan's name" in scan.notes
    assert_allclose(color_near_corner(scan, np.zeros(3)), CORNER_LINEAR[0], atol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\nf -4 -3 -2 -1\n",
        "v 0 0 0\nv 100 0 0\nv 100 100 0\nf -3 -2 -1\nv 0 100 0\nf 1 3 -1\n",
        "v 0 0 0\r\nv 100 0 0\r\nv 100 100 0\r\nv 0 100 0\r\nf 1 2 3 4\r\n",
        "v 0 0 0\rv 100 0 0\rv 100 100 0\rv 0 100 0\rf 1 2 3 4\r",
        "# CR behind the first line\nv 0 0 0\rv 100 0 0\rv 100 100 0\rv 0 100 0\rf 1 2 3 4\r",
        "v 0,0 0 0\nv 1,0e2 0, 0\nv +100,00 ,1E3 -0,0\nv 0 100,0 0\nf 1 2 3 4\n",
        "v 0D+00 0D0 0\nv 1.0D+02 0 0\nv 1.D2 10000d-2 0\nv 0 .1D3 0\nf 1 2 3 4\n",
        "v 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\nf 1 2 3 4\n".encode("utf-16"),
        "  v\t0 0\\\n 0 # first\n\n\tv 100 0 0 1\nv 1e2 +1.0E2 -0\nv 0 100. .0\n f 1//1 2//1 3//1 4//1 # q",
        "vn 0 0 1\nv 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\ng nose\ns off\nf 1/ 2/ 3/ 4/\nl 1 2\n",
    ],
)
def test_ways_to_write_the_same_square(tmp_path, text):
    scan = load_scan(write(tmp_path, text))
    assert_array_equal(scan.vertices, [[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0]])
    assert_array_equal(scan.faces, [[0, 1, 2], [0, 2, 3]])


def test_libraries_of_utf16_and_of_lines_that_end_with_cr_are_found(tmp_path):
    path = write_square_obj(tmp_path)
    text, before, library = path.read_text(), input_sha256(path), tmp_path / "face.mtl"
    skin = library.read_text()
    for written in (text.encode("utf-16"), ("# of a Mac\n" + text).replace("\n", "\r").encode()):
        path.write_bytes(written)
        assert_corner_colors(load_scan(path))
        library.write_text(skin + "#" * 9)
        changed = input_sha256(path)
        library.write_text(skin)
        assert len({before, changed, input_sha256(path)}) == 3


def test_polygons_keep_the_coordinates_of_their_corners(tmp_path):
    angles = np.arange(6) * np.pi / 3
    ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])
    text = obj_text(100 * ring, [range(6)], ring[:, :2] / 2 + 0.5)
    scan = load_scan(write(tmp_path, text))
    assert len(scan.faces) == 4
    assert_allclose(scan.uv * 200 - 100, scan.vertices[scan.faces][..., :2], atol=1e-12)
    assert "polygons cut into triangles: 1" in scan.notes


def test_vertex_colours_are_srgb(tmp_path):
    expected = [[1, 0, 0], [0, 1, 0], [0.21404114] * 3]
    for one, half in (("1", "0.5"), ("255", "127.5")):
        text = f"v 0 0 0 {one} 0 0\nv 100 0 0 0 {one} 0\nv 0 100 0 {half} {half} {half}\nf 1 2 3"
        scan = load_scan(write(tmp_path, text))
        assert_allclose(scan.vertex_color_linear, expected, rtol=1e-6)


def test_several_materials_become_one_texture(tmp_path):
    write_image(tmp_path / "other.png", np.ascontiguousarray(quarters(16)[:, ::-1]))
    scan = load_scan(square_of_two_materials(tmp_path))
    found = [color_near_corner(scan, SQUARE_MM[corner]) for corner in (1, 3)]
    assert_allclose(found, CORNER_LINEAR[[1, 2]], atol=1e-6)
    assert any(note.startswith("packed 2 textures into one of") for note in scan.notes)


def test_texture_maps_of_free_form_files_are_no_materials(tmp_path):
    path = write_square_obj(tmp_path)
    text = path.read_text()
    path.write_text(text.replace("usemtl", "maplib other.map\nusemap other\nusemtl", 1) + "\nusemap off\n")
    scan = load_scan(path)
    assert_corner_colors(scan)
    assert not any("material" in note for note in scan.notes)
    path.write_text(text.replace("usemtl skin", "usemtl skin\nusemap other"))
    assert_corner_colors(load_scan(path))


def test_faces_without_coordinates_get_their_materials_colour(tmp_path):
    last = "f 1/1 3/3 4/4\n"
    more = (last, f"{last}v 200 0 0\nv 200 120 0\nusemtl cloth\nf 2 5 6\n")
    library = "newmtl skin\nmap_Kd face.png\nnewmtl cloth\nKd 0.5 0 1\n"
    scan = load_scan(write_square_obj(tmp_path, mtl=library, change=more))
    assert_corner_colors(scan)
    assert_allclose(color_near_corner(scan, np.array([200.0, 120, 0])), [0.21404114, 0, 1], rtol=1e-6)
    assert "faces without texture, given their material's colour: 1" in scan.notes


def test_numbers_are_read_to_the_last_bit_but_one(tmp_path):
    values = np.random.default_rng(1).normal(size=(300, 3)) * 10.0 ** np.arange(-150, 150)[:, None]
    parsed = read_obj(write(tmp_path, obj_text(values, [(0, 1, 2)])), ScanFolder(tmp_path))
    assert_allclose(parsed.vertices, values, rtol=5e-16 * 4)


@pytest.mark.parametrize("token", ["nan", "NaN", "-nan", "inf", "-Infinity", "1.#QNAN", "-1.#IND"])
def test_numbers_that_are_none_are_reported_as_such(tmp_path, token):
    path = write(tmp_path, f"v 0 0 0\nv 100 {token} 0\nv 0 100 0\nv 0 100 1\nf 1 2 3\n")
    assert_refused(path, r"a\.obj: 1 vertices used by faces are NaN or infinite.*vertex 1 ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nv 1 0 x\nf 1 1 1", r"line 2 holds '1 0 x', expected at least 3 numbers"),
        ("v 0 0 0\nv 1 0\nf 1 1 1", r"line 2 holds '1 0', expected at least 3 numbers"),
        ("v 0 0 0\nf 1 2", r"line 2 holds '1 2', expected at least 3 corners"),
        ("v 0 0 0\nf 1 1 2", r"line 2 holds '1 1 2', but there are 1 vertices"),
        ("v 0 0 0\nf 1 1 -2", r"line 2 .* index before 1"),
        ("v 0 0 0\nf 1 1 0", r"line 2 .* expected corners like"),
        ("v 0 0 0\nf 1 1 a", r"line 2 .* expected corners like"),
        ("v 0 0 0\nvt 0 0\nf 1/1 1/2 1/1", r"line 3 .* but there are 1 texture coordinates"),
        ("v 0 0 0\nf 1 1 99999999999999999999", r"line 2 .* expected corners like"),
    ],
)
def test_damaged_lines_are_named(tmp_path, text, message):
    assert_refused(write(tmp_path, text), rf"a\.obj: {message}")


def test_mtl_numbers_that_are_none_leave_the_default():
    grey, quarter = srgb_to_linear([0.5, 0.25]).tolist()
    assert parse_mtl("newmtl a\nKd red green\n")["a"].base_color_linear == (grey, grey, grey)
    assert parse_mtl("newmtl a\nKd 0.25\n")["a"].base_color_linear == (quarter, quarter, quarter)
    assert parse_mtl("Kd 1 1 1\nmap_Kd lost.png\n") == {}
    assert parse_mtl("newmtl a\n\tmap_Kd\t2 faces.png\n")["a"].texture_file == "2 faces.png"


def test_a_mesh_comes_back_to_the_last_bit(tmp_path):
    vertices, faces = np.random.default_rng(0).normal(size=(5, 3)) * 90, np.array([[0, 1, 2], [2, 3, 4]])
    write_obj(tmp_path / "a.obj", vertices, faces)
    scan = load_scan(tmp_path / "a.obj", "mm")
    assert_allclose(scan.vertices, vertices, rtol=4e-16)
    assert_array_equal(scan.faces, faces)


@pytest.mark.parametrize("library", [None, "", "newmtl skin\nmap_Kd lost.png\n"])
def test_a_picture_of_the_scans_own_name_stands_in_for_what_is_missing(tmp_path, library):
    path = write_square_obj(tmp_path, mtl=library or "")
    if library is None:
        (tmp_path / "face.mtl").unlink()
    scan = load_scan(path)
    assert_corner_colors(scan)
    assert "texture face.png was found by the scan's name" in scan.notes
    before = input_sha256(path)
    write_image(tmp_path / "face.png", quarters(16))
    assert input_sha256(path) != before


def test_materials_that_share_a_picture_read_it_once(tmp_path):
    path = square_of_two_materials(tmp_path, second="-clamp on ./face.png")
    read = parsed_mesh.read_image_linear
    with mock.patch.object(parsed_mesh, "read_image_linear", wraps=read) as reading:
        scan = load_scan(path)
    reading.assert_called_once()
    assert scan.texture_linear.shape == (8, 8, 3)
    assert not any("packed" in note for note in scan.notes)
    assert_corner_colors(scan)


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-8-sig"])
def test_names_of_other_scripts_in_obj_and_mtl(tmp_path, encoding):
    path = write_square_obj(tmp_path, name="Jürgen", texture="Gesicht é.png")
    for file in (path, path.with_suffix(".mtl")):
        file.write_text(file.read_text(), encoding)
    assert_corner_colors(load_scan(path))


def test_names_in_another_unicode_form_and_other_code_pages(tmp_path):
    path = write_square_obj(tmp_path)
    (tmp_path / "face.png").rename(tmp_path / unicodedata.normalize("NFD", "Gesichté.png"))
    library = tmp_path / "face.mtl"
    library.write_text("newmtl skin\nmap_Kd Gesichté.png\n")
    assert_corner_colors(load_scan(path))
    next(tmp_path.glob("Gesicht*")).rename(tmp_path / "顔.png")
    for encoding in ("cp932", "gbk"):
        library.write_bytes("newmtl skin\nmap_Kd 顔.png\n".encode(encoding))
        assert_corner_colors(load_scan(path))


@pytest.mark.parametrize("kind", ["map_Ka", "map_Ke"])
def test_a_picture_in_another_slot_is_the_colour_of_a_material_without(kind):
    assert parse_mtl(f"newmtl a\n{kind} glow.png\n")["a"].texture_file == "glow.png"
    for lines in (f"{kind} glow.png\nmap_Kd skin.png\n", f"map_Kd skin.png\n{kind} glow.png\n"):
        assert parse_mtl(f"newmtl a\n{lines}")["a"].texture_file == "skin.png"


@pytest.mark.parametrize("weight", ["", "1 "])
def test_vertices_without_a_colour_were_not_seen(tmp_path, weight):
    text = obj_text(SQUARE_MM, [(0, 1, 2), (0, 2, 3)])
    for place, color in (("0 0 0", "1 0 0"), ("100 120 0", "0 1 0"), ("0 120 0", "0 0 1")):
        text = text.replace(f"v {place}\n", f"v {place} {weight}{color}\n")
    scan = load_scan(write(tmp_path, text))
    assert_array_equal(scan.vertex_color_linear[[0, 2, 3]], np.eye(3))
    assert scan.color_seen.tolist() == [True, False, True, True]


@pytest.mark.parametrize(
    ("options", "placement"),
    [
        ("-s 0.5 0.25 1 -o 0.25 0.5 0", (0.5, 0.25, 0.25, 0.5)),
        ("-o .5", (1, 1, 0.5, 0)),
        ("-bm 1 -s 2 -o 1.2.3 0", (2, 1, 0, 0)),
    ],
)
def test_a_picture_is_looked_up_where_its_scale_and_offset_say(tmp_path, options, placement):
    path = write_square_obj(tmp_path, mtl=f"newmtl skin\nmap_Kd {options} face.png\n")
    scale, offset = np.array(placement).reshape(2, 2)
    parsed = read_obj(path, ScanFolder(tmp_path))
    assert_allclose(parsed.uv, SQUARE_UV[parsed.faces] * scale + offset)
    (tmp_path / "face.mtl").write_text("newmtl skin\nmap_Kd -s 1e308 -o 1e999 face.png\n")
    assert load_scan(path).texture_linear is None or not load_scan(path).color_seen.any()


def test_a_renamed_material_is_the_only_one_of_its_library(tmp_path):
    scan = load_scan(write_square_obj(tmp_path, change=("usemtl skin", "usemtl lambert2SG")))
    assert_corner_colors(scan)
    assert "material lambert2SG is not in the material library: took its only one, skin" in scan.notes


def test_colours_that_zbrush_painted(tmp_path):
    mesh, first = obj_text(SQUARE_MM, [range(4)]), "#MRGB ffff00000000ff00\n"
    scan = load_scan(write(tmp_path, f"{mesh}{first}#MRGB FF0000FFff808080"))
    assert_allclose(scan.vertex_color_linear, CORNER_LINEAR, atol=1e-6)
    for wrong in ("ff00ff00", "ff0", "grey"):
        scan = load_scan(write(tmp_path, f"{mesh}{first}#MRGB {wrong}"))
        assert scan.vertex_color_linear is None
        assert any("#MRGB colours are not those of its vertices" in note for note in scan.notes)
