import numpy as np
import pytest
from helpers.square import (
    CORNER_COLORS,
    CORNER_LINEAR,
    SQUARE_FACES,
    SQUARE_MM,
    SQUARE_UV,
    assert_corner_colors,
    quarters,
    write_image,
)

from scan2albedo.errors import ScanError
from scan2albedo.io import load_scan

FORMATS = ["ascii", "binary_little_endian", "binary_big_endian"]


def ply(path, layout, elements, comments=()):
    """Write elements {name: (declarations, rows of (dtype, values))} by hand."""
    head = ["ply", f"format {layout} 1.0", *(f"comment {c}" for c in comments)]
    body = b""
    order = ">" if "big" in layout else "<"
    for name, (declarations, rows) in elements.items():
        head += [f"element {name} {len(rows)}", *(f"property {d}" for d in declarations)]
        for row in rows:
            if layout == "ascii":
                body += (" ".join(repr(v) for _, values in row for v in values) + "\n").encode()
            else:
                body += b"".join(np.array(values, order + dtype).tobytes() for dtype, values in row)
    path.write_bytes(("\n".join(head) + "\nend_header\n").encode() + body)
    return path


def positions(extra=()):
    rows = [[("f4", [float(x) for x in v])] for v in SQUARE_MM]
    return [row + list(more) for row, more in zip(rows, extra, strict=True)] if extra else rows


def triangles():
    return [[("u1", [3]), ("i4", [int(i) for i in f])] for f in SQUARE_FACES]


XYZ = ["float x", "float y", "float z"]
INDICES = ["list uchar int vertex_indices"]


@pytest.mark.parametrize("layout", FORMATS)
def test_vertex_colours_are_srgb_bytes(tmp_path, layout):
    colors = [[("u1", list(c))] for c in CORNER_COLORS.values()]
    path = ply(
        tmp_path / "a.ply",
        layout,
        {
            "vertex": ([*XYZ, "uchar red", "uchar green", "uchar blue"], positions(colors)),
            "face": (INDICES, triangles()),
        },
    )
    scan = load_scan(path)
    np.testing.assert_array_equal(scan.vertices, SQUARE_MM)
    np.testing.assert_array_equal(scan.faces, SQUARE_FACES)
    np.testing.assert_allclose(scan.vertex_color_linear, CORNER_LINEAR, rtol=1e-6)
    assert scan.has_color


@pytest.mark.parametrize(
    ("kind", "dtype", "top"), [("ushort", "u2", 65535), ("float", "f4", 1), ("float", "f4", 255)]
)
def test_vertex_colours_of_other_types(tmp_path, kind, dtype, top):
    colors = [
        [(dtype, [c / 255 * top if dtype == "f4" else c * 257 for c in color])]
        for color in CORNER_COLORS.values()
    ]
    names = [f"{kind} {c}" for c in ("red", "green", "blue")]
    elements = {"vertex": ([*XYZ, *names], positions(colors)), "face": (INDICES, triangles())}
    scan = load_scan(ply(tmp_path / "a.ply", "binary_little_endian", elements))
    np.testing.assert_allclose(scan.vertex_color_linear, CORNER_LINEAR, rtol=1e-5)


@pytest.mark.parametrize("layout", FORMATS)
def test_coordinates_with_the_corners(tmp_path, layout):
    write_image(tmp_path / "my face.png", quarters())
    rows = [
        [
            ("u1", [3]),
            ("i4", [int(i) for i in f]),
            ("u1", [6]),
            ("f4", [float(x) for i in f for x in SQUARE_UV[i]]),
        ]
        for f in SQUARE_FACES
    ]
    elements = {"vertex": (XYZ, positions()), "face": ([*INDICES, "list uchar float texcoord"], rows)}
    scan = load_scan(ply(tmp_path / "a.ply", layout, elements, ["TextureFile my face.png"]))
    np.testing.assert_array_equal(scan.uv, SQUARE_UV[SQUARE_FACES])
    assert_corner_colors(scan)


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_coordinates_with_the_vertices(tmp_path, names):
    write_image(tmp_path / "face.png", quarters())
    extra = [[("f4", [float(x) for x in uv])] for uv in SQUARE_UV]
    declared = [*XYZ, *(f"float {n}" for n in names)]
    elements = {"vertex": (declared, positions(extra)), "face": (INDICES, triangles())}
    assert_corner_colors(load_scan(ply(tmp_path / "a.ply", "ascii", elements, ["TextureFile face.png"])))


def test_a_missing_texture_is_told(tmp_path):
    elements = {"vertex": (XYZ, positions()), "face": (INDICES, triangles())}
    scan = load_scan(ply(tmp_path / "a.ply", "ascii", elements, ["TextureFile lost.png"]))
    assert any("lost.png is missing" in note for note in scan.notes)


def test_two_textures_chosen_by_number(tmp_path):
    write_image(tmp_path / "white.png", np.full((4, 4, 3), 255, np.uint8))
    write_image(tmp_path / "black.png", np.zeros((6, 3, 3), np.uint8))
    rows = [
        [("u1", [3]), ("i4", [int(i) for i in f]), ("u1", [6]), ("f4", [0.5] * 6), ("i4", [k])]
        for k, f in enumerate(SQUARE_FACES)
    ]
    declared = [*INDICES, "list uchar float texcoord", "int texnumber"]
    elements = {"vertex": (XYZ, positions()), "face": (declared, rows)}
    scan = load_scan(
        ply(
            tmp_path / "a.ply",
            "binary_little_endian",
            elements,
            [f"TextureFile {n}.png" for n in ("white", "black")],
        )
    )
    height, width = scan.texture_linear.shape[:2]
    columns, rows = (scan.uv[..., 0] * width).astype(int), ((1 - scan.uv[..., 1]) * height).astype(int)
    np.testing.assert_array_equal(scan.texture_linear[rows, columns].mean((1, 2)), [1, 0])


@pytest.mark.parametrize("layout", FORMATS)
@pytest.mark.parametrize(("counter", "dtype"), [("uchar", "u1"), ("ushort", "u2"), ("int", "i4")])
def test_triangles_and_quads_mixed(tmp_path, layout, counter, dtype):
    points = np.array([[0.0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0], [50, 150, 0]])
    rows = [[(dtype, [4]), ("u2", [0, 1, 2, 3]), ("u1", [9])], [(dtype, [3]), ("u2", [3, 2, 4]), ("u1", [7])]]
    elements = {
        "vertex": (XYZ, [[("f4", [float(x) for x in p])] for p in points]),
        "face": ([f"list {counter} ushort vertex_index", "uchar quality"], rows),
    }
    scan = load_scan(ply(tmp_path / "a.ply", layout, elements))
    np.testing.assert_array_equal(scan.faces, [[0, 1, 2], [0, 2, 3], [3, 2, 4]])
    assert "polygons cut into triangles: 1" in scan.notes


def test_other_elements_and_long_headers_are_passed_over(tmp_path):
    elements = {
        "camera": (["float view", "list uchar short curve"], [[("f4", [1.5]), ("u1", [2]), ("i2", [4, 5])]]),
        "vertex": (XYZ, positions()),
        "face": (INDICES, triangles()),
        "edge": (["int vertex1"], [[("i4", [1])]]),
    }
    scan = load_scan(ply(tmp_path / "a.PLY", "binary_little_endian", elements, ["note " + "x" * 500] * 50))
    np.testing.assert_array_equal(scan.faces, SQUARE_FACES)


@pytest.mark.parametrize("layout", FORMATS)
@pytest.mark.parametrize("part", [0.2, 0.62, 0.97])
def test_truncated_files_are_refused_by_name(tmp_path, layout, part):
    elements = {"vertex": (XYZ, positions()), "face": (INDICES, triangles())}
    path = ply(tmp_path / "a.ply", layout, elements)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(ScanError, match=r"a\.ply: .*(truncated|point cloud)"):
        load_scan(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((b"format ascii 1.0", b"format morse 1.0"), "its header holds 'format morse"),
        ((b"element vertex 4", b"element vertex four"), "its header holds 'element vertex four"),
        ((b"property float z", b"property quaternion z"), "its header holds 'property quaternion z"),
        ((b"property float z", b"property float w"), "its vertices have no z"),
        ((b"end_header", b"end_of_it"), "no complete PLY header"),
        ((b"3 0 1 2", b"2 0 1"), "face 0 has 2 corners"),
        ((b"3 0 1 2", b"3 0 1 9"), "a face refers to vertex 9, but there are 4"),
        ((b"3 0 1 2", b"3 0 1 -2"), "a face refers to vertex -2, but there are 4"),
        ((b"3 0 1 2", b"7 0 1 2"), "a list vertex_indices of face is cut short"),
        ((b"100.0 0.0 0.0", b"100.0 nan 0.0"), "1 vertices used by faces are NaN.*vertex 1"),
        ((b"3 0 1 2", b"3 0 1 nan"), "vertex_indices of face holds nan, which int32 cannot hold"),
        ((b"3 0 1 2", b"nan 0 1 2"), "a list vertex_indices of face is cut short"),
        ((b"property float y", b"property float x"), "its vertex has no properties, or one twice"),
        ((b"100.0 0.0 0.0", b"1e99 0.0 0.0"), "1 vertices used by faces are NaN or infinite.*vertex 1"),
        ((b"100.0 0.0 0.0", b"100.0 zero 0.0"), "vertex 1 is not made of numbers"),
        ((b"element face 2", b"element face 0"), "point cloud of 4 vertices"),
        ((b"element face 2", b"element strips 2"), "point cloud of 4 vertices"),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path, change, message):
    path = ply(tmp_path / "a.ply", "ascii", {"vertex": (XYZ, positions()), "face": (INDICES, triangles())})
    data = path.read_bytes()
    assert change[0] in data
    path.write_bytes(data.replace(*change))
    with pytest.raises(ScanError, match=r"a\.ply: .*" + message):
        load_scan(path)


@pytest.mark.parametrize("layout", FORMATS)
def test_a_count_beyond_the_file_is_refused_without_making_room_for_it(tmp_path, layout):
    path = ply(tmp_path / "a.ply", layout, {"vertex": (XYZ, positions()), "face": (INDICES, triangles())})
    path.write_bytes(path.read_bytes().replace(b"element face 2", b"element face 2000000000000"))
    with pytest.raises(ScanError, match=r"a\.ply: it declares 2000000000000 face rows"):
        load_scan(path)


def test_coordinates_that_are_lists_are_no_coordinates(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty list uchar float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "1 0 0 0\n2 1 1 0 0\n1 0 1 0\n3 0 1 2\n"
    )
    with pytest.raises(ScanError, match=r"a\.ply: its vertices have no x"):
        load_scan(tmp_path / "a.ply")


def test_trimesh_reads_the_same(tmp_path):
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=2, radius=80)
    for encoding in ("ascii", "binary"):
        path = tmp_path / f"{encoding}.ply"
        path.write_bytes(mesh.export(file_type="ply", encoding=encoding))
        scan = load_scan(path)
        np.testing.assert_array_equal(scan.faces, mesh.faces)
        np.testing.assert_allclose(scan.vertices, mesh.vertices, rtol=1e-6, atol=1e-5)


def test_a_picture_of_the_scans_own_name_stands_in_for_what_is_missing(tmp_path):
    corners = [
        [*row, ("u1", [6]), ("f4", SQUARE_UV[f].ravel().tolist())]
        for row, f in zip(triangles(), SQUARE_FACES, strict=True)
    ]
    path = ply(
        tmp_path / "a.ply",
        "binary_little_endian",
        {"vertex": (XYZ, positions()), "face": ([*INDICES, "list uchar float texcoord"], corners)},
        comments=["TextureFile lost.png"],
    )
    write_image(tmp_path / "a.png", quarters())
    scan = load_scan(path)
    assert_corner_colors(scan)
    assert "texture a.png was found by the scan's name" in scan.notes


@pytest.mark.parametrize("layout", FORMATS)
@pytest.mark.parametrize("rows", [[[0, 1, 2, -1, 2, 3, 0]], [[1, 2, 0, 3]], [[0, 1, 2], [2, 3, 0, -1]]])
def test_triangle_strips(tmp_path, layout, rows):
    strips = [[("i4", [len(row)]), ("i4", row)] for row in rows]
    elements = {"vertex": (XYZ, positions()), "tristrips": (["list int int vertex_indices"], strips)}
    scan = load_scan(ply(tmp_path / "a.ply", layout, elements))
    np.testing.assert_array_equal(scan.vertices, SQUARE_MM)

    def begins(faces):
        return {tuple(np.roll(face, -np.argmin(face))) for face in faces.tolist()}

    assert begins(scan.faces) == begins(SQUARE_FACES)


def test_colours_of_faces_are_averaged_at_vertices(tmp_path):
    colors = ["uchar red", "uchar green", "uchar blue"]
    rows = [[*row, ("u1", [255 * k, 0, 255])] for k, row in enumerate(triangles())]
    path = ply(tmp_path / "a.ply", "ascii", {"vertex": (XYZ, positions()), "face": (INDICES + colors, rows)})
    np.testing.assert_allclose(load_scan(path).vertex_color_linear[:, 0], [0.5, 0, 0.5, 1])
    np.testing.assert_allclose(load_scan(path).vertex_color_linear[:, 2], 1)
