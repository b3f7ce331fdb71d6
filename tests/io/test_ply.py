import numpy as np
import pytest
from helpers.scan_files import assert_refused
from helpers.square import (
    CORNER_COLORS,
    CORNER_LINEAR,
    SQUARE_FACES,
    SQUARE_MM,
    SQUARE_UV,
    assert_corner_colors,
    quarters,
    sample,
    write_image,
)
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.mesh import face_normals
from scan2albedo.io import load_scan

FORMATS = ["ascii", "binary_little_endian", "binary_big_endian"]


XYZ = ["float x", "float y", "float z"]
INDICES = ["list uchar int vertex_indices"]
RGB = ["uchar red", "uchar green", "uchar blue"]
POINTS = [[("f4", place)] for place in SQUARE_MM.tolist()]
TRIANGLES = [[("u1", [3]), ("i4", face)] for face in SQUARE_FACES.tolist()]


def joined(rows, more):
    """Return rows of (dtype, values) with further cells each."""
    return [row + cells for row, cells in zip(rows, more, strict=True)]


def ply(folder, layout="ascii", comments=(), vertex=(XYZ, POINTS), face=(INDICES, TRIANGLES), **elements):
    """Write elements (declarations, rows of (dtype, values)) by hand as a.ply; return its path."""
    head = ["ply", f"format {layout} 1.0", *(f"comment {c}" for c in comments)]
    body, order = b"", ">" if "big" in layout else "<"
    for name, (declarations, rows) in (elements | {"vertex": vertex, "face": face}).items():
        if not declarations:
            continue
        head += [f"element {name} {len(rows)}", *(f"property {d}" for d in declarations)]
        for row in rows:
            if layout == "ascii":
                body += (" ".join(repr(v) for _, values in row for v in values) + "\n").encode()
            else:
                body += b"".join(np.array(values, order + dtype).tobytes() for dtype, values in row)
    (folder / "a.ply").write_bytes(("\n".join(head) + "\nend_header\n").encode() + body)
    return folder / "a.ply"


KINDS = {"u1": "uchar", "u2": "ushort", "f4": "float", "i4": "int"}


@pytest.mark.parametrize("layout", FORMATS)
@pytest.mark.parametrize(("dtype", "top"), [("u1", 255), ("u2", 65535), ("f4", 1), ("f4", 255)])
def test_vertex_colours_are_srgb(tmp_path, layout, dtype, top):
    number = float if dtype == "f4" else int
    colors = [[(dtype, [number(c * top / 255) for c in color])] for color in CORNER_COLORS.values()]
    names = [name.replace("uchar", KINDS[dtype]) for name in RGB]
    scan = load_scan(ply(tmp_path, layout, vertex=(XYZ + names, joined(POINTS, colors))))
    assert_array_equal(scan.vertices, SQUARE_MM)
    assert_array_equal(scan.faces, SQUARE_FACES)
    assert_allclose(scan.vertex_color_linear, CORNER_LINEAR, rtol=1e-5)


TEXCOORD = [*INDICES, "list uchar float texcoord"]
TEXTURED = joined(TRIANGLES, [[("u1", [6]), ("f4", SQUARE_UV[f].ravel().tolist())] for f in SQUARE_FACES])


def test_coordinates_with_the_corners(tmp_path):
    write_image(tmp_path / "my face.png", quarters())
    scan = load_scan(ply(tmp_path, FORMATS[2], ["TextureFile my face.png"], face=(TEXCOORD, TEXTURED)))
    assert_array_equal(scan.uv, SQUARE_UV[SQUARE_FACES])
    assert_corner_colors(scan)


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_coordinates_with_the_vertices(tmp_path, names):
    write_image(tmp_path / "face.png", quarters())
    rows = joined(POINTS, [[("f4", place)] for place in SQUARE_UV.tolist()])
    declared = [*XYZ, *(f"float {name}" for name in names)]
    assert_corner_colors(load_scan(ply(tmp_path, comments=["TextureFile face.png"], vertex=(declared, rows))))


def test_a_missing_texture_is_told_and_one_of_the_scans_own_name_taken(tmp_path):
    path = ply(tmp_path, comments=["TextureFile lost.png"], face=(TEXCOORD, TEXTURED))
    assert any("lost.png is missing" in note for note in load_scan(path).notes)
    write_image(tmp_path / "a.png", quarters())
    scan = load_scan(path)
    assert_corner_colors(scan)
    assert "texture a.png was found by the scan's name" in scan.notes


def test_two_textures_chosen_by_number(tmp_path):
    write_image(tmp_path / "white.png", np.full((4, 4, 3), 255, np.uint8))
    write_image(tmp_path / "black.png", np.zeros((6, 3, 3), np.uint8))
    rows = joined(TRIANGLES, [[("u1", [6]), ("f4", [0.5] * 6), ("i4", [k])] for k in range(2)])
    files = ["TextureFile white.png", "TextureFile black.png"]
    scan = load_scan(ply(tmp_path, FORMATS[1], files, face=([*TEXCOORD, "int texnumber"], rows)))
    assert_array_equal([sample(scan, uv).mean() for uv in scan.uv], [1, 0])


@pytest.mark.parametrize("layout", FORMATS)
@pytest.mark.parametrize("dtype", ["u1", "u2", "i4"])
def test_triangles_and_quads_mixed(tmp_path, layout, dtype):
    points = [*POINTS, [("f4", [50.0, 150, 0])]]
    rows = [[(dtype, [4]), ("u2", [0, 1, 2, 3]), ("u1", [9])], [(dtype, [3]), ("u2", [3, 2, 4]), ("u1", [7])]]
    declared = [f"list {KINDS[dtype]} ushort vertex_index", "uchar quality"]
    scan = load_scan(ply(tmp_path, layout, vertex=(XYZ, points), face=(declared, rows)))
    assert_array_equal(scan.faces, [[0, 1, 2], [0, 2, 3], [3, 2, 4]])
    assert "polygons cut into triangles: 1" in scan.notes


def test_other_elements_and_long_headers_are_passed_over(tmp_path):
    camera = ["float view", "list uchar short curve"], [[("f4", [1.5]), ("u1", [2]), ("i2", [4, 5])]]
    edge, notes = (["int vertex1"], [[("i4", [1])]]), ["note " + "x" * 500] * 50
    path = ply(tmp_path, FORMATS[1], notes, camera=camera, edge=edge)
    path.rename(tmp_path / "a.PLY")
    assert_array_equal(load_scan(tmp_path / "a.PLY").faces, SQUARE_FACES)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"format ascii 1.0", b"format morse 1.0", "its header holds 'format morse"),
        (b"element vertex 4", b"element vertex four", "its header holds 'element vertex four"),
        (b"property float z", b"property quaternion z", "its header holds 'property quaternion z"),
        (b"property float z", b"property float w", "its vertices have no z"),
        (b"end_header", b"end_of_it", "no complete PLY header"),
        (b"3 0 1 2", b"2 0 1", "face 0 has 2 corners"),
        (b"3 0 1 2", b"3 0 1 9", "a face refers to vertex 9, but there are 4"),
        (b"3 0 1 2", b"3 0 1 -2", "a face refers to vertex -2, but there are 4"),
        (b"3 0 1 2", b"7 0 1 2", "a list vertex_indices of face is cut short"),
        (b"100.0 0.0 0.0", b"100.0 nan 0.0", "1 vertices used by faces are NaN.*vertex 1"),
        (b"3 0 1 2", b"3 0 1 nan", "vertex_indices of face holds nan, which int32 cannot hold"),
        (b"3 0 1 2", b"nan 0 1 2", "a list vertex_indices of face is cut short"),
        (b"property float y", b"property float x", "its vertex has no properties, or one twice"),
        (b"100.0 0.0 0.0", b"1e99 0.0 0.0", "1 vertices used by faces are NaN or infinite.*vertex 1"),
        (b"100.0 0.0 0.0", b"100.0 zero 0.0", "vertex 1 is not made of numbers"),
        (b"element face 2", b"element face 2000000000000", "it declares 2000000000000 face rows"),
        (b"element face 2", b"element face 0", "point cloud of 4 vertices"),
        (b"element face 2", b"element strips 2", "point cloud of 4 vertices"),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path, old, new, message):
    path = ply(tmp_path)
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))
    assert_refused(path, rf"a\.ply: .*{message}")


def test_coordinates_that_are_lists_are_no_coordinates(tmp_path):
    rows = [[("u1", [1]), *row] for row in POINTS]
    path = ply(tmp_path, vertex=(["list uchar float x", *XYZ[1:]], rows))
    assert_refused(path, r"a\.ply: its vertices have no x")


@pytest.mark.parametrize("rows", [[[0, 1, 2, -1, 2, 3, 0]], [[1, 2, 0, 3]], [[0, 1, 2], [2, 3, 0, -1]]])
def test_triangle_strips(tmp_path, rows):
    strips = ["list int int vertex_indices"], [[("i4", [len(row)]), ("i4", row)] for row in rows]
    scan = load_scan(ply(tmp_path, FORMATS[1], face=((), ()), tristrips=strips))
    assert_array_equal(scan.vertices, SQUARE_MM)
    assert_array_equal(np.sort(np.sort(scan.faces), axis=0), SQUARE_FACES)
    assert (face_normals(scan.vertices, scan.faces)[:, 2] > 0).all()


def test_colours_of_faces_are_averaged_at_vertices(tmp_path):
    rows = joined(TRIANGLES, [[("u1", [255 * k, 0, 255])] for k in range(2)])
    colors = load_scan(ply(tmp_path, face=(INDICES + RGB, rows))).vertex_color_linear
    assert_allclose(colors[:, 0], [0.5, 0, 0.5, 1])
    assert_allclose(colors[:, 2], 1)
