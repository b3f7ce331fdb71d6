import numpy as np
import pytest
import trimesh
from helpers.square import CORNER_COLORS, CORNER_LINEAR, SQUARE_FACES, SQUARE_MM
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import ScanError
from scan2albedo.io import load_scan

SPHERE = trimesh.creation.icosphere(subdivisions=2, radius=80.0)


def exported(kind, mesh=SPHERE):
    data = mesh.export(file_type=kind)
    return data if isinstance(data, bytes) else data.encode()


def written(path, data):
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_comes_back_welded(tmp_path, kind):
    scan = load_scan(written(tmp_path / "a.STL", exported(kind)))
    assert scan.vertices.shape == SPHERE.vertices.shape
    assert_allclose(
        np.sort(scan.vertices[scan.faces].reshape(-1, 9), axis=0),
        np.sort(SPHERE.triangles.reshape(-1, 9), axis=0),
        atol=1e-4,
    )
    assert f"vertices merged at equal positions (seams): {3 * len(SPHERE.faces) - 162}" in scan.notes


def test_a_binary_stl_may_begin_with_solid(tmp_path):
    path = written(tmp_path / "a.stl", b"solid" + exported("stl")[5:])
    assert len(load_scan(path).faces) == len(SPHERE.faces)


@pytest.mark.parametrize("part", [0.001, 0.3, 0.999])
@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_truncated_stl_is_refused_by_name(tmp_path, kind, part):
    data = exported(kind)
    with pytest.raises(ScanError, match=r"a\.stl: .*truncated"):
        load_scan(written(tmp_path / "a.stl", data[: int(len(data) * part)]))


def test_all_solids_of_a_text_stl_are_read(tmp_path):
    other = SPHERE.copy()
    other.apply_translation((300, 0, 0))
    text = b"\n".join(exported("stl_ascii", mesh) for mesh in (SPHERE, other))
    assert len(load_scan(written(tmp_path / "a.stl", text), "mm").faces) == 2 * len(SPHERE.faces)
    with pytest.raises(ScanError, match=r"b\.stl: .*endsolid.*truncated"):
        load_scan(written(tmp_path / "b.stl", text[: int(0.8 * len(text))]))


@pytest.mark.parametrize(
    ("old", "new"), [(b"endloop\n", b"endloop "), (b"solid \n", b"solid by # 5 vertex\n")]
)
def test_a_text_stl_of_other_lines_gives_the_same(tmp_path, old, new):
    text = exported("stl_ascii")
    assert old in text
    plain = load_scan(written(tmp_path / "a.stl", text))
    other = load_scan(written(tmp_path / "b.stl", text.replace(old, new)))
    assert_allclose(other.vertices, plain.vertices, rtol=1e-14)
    assert_array_equal(other.faces, plain.faces)


def test_the_name_of_a_text_stl_may_be_in_any_encoding(tmp_path):
    text = exported("stl_ascii").replace(b"solid", b"solid Gesch\xfctz", 1)
    assert len(load_scan(written(tmp_path / "a.stl", text)).faces) == len(SPHERE.faces)


@pytest.mark.parametrize(
    "data", [bytes(84), b"solid\nvertex 0 0\nvertex 1 0\nvertex 1 1\nendsolid\n", b"solid\nendsolid\n"]
)
def test_an_stl_without_triangles_is_refused_by_name(tmp_path, data):
    with pytest.raises(ScanError, match=r"a\.stl: .*damaged"):
        load_scan(written(tmp_path / "a.stl", data))


def off(path, header="OFF", vertices=None, faces=None, counts=None):
    rows = [" ".join(str(x) for x in v) for v in (SQUARE_MM if vertices is None else vertices)]
    cells = faces or ["3 0 1 2", "3 0 2 3"]
    counts = counts or f"{len(rows)} {len(cells)} 0"
    path.write_text("\n".join([header, counts, *rows, *cells]))
    return path


@pytest.mark.parametrize(
    ("header", "counts"),
    [("OFF", None), ("# made by hand\nOFF # it is\n\n", None), ("OFF 4 2 0", "# counted")],
)
def test_off(tmp_path, header, counts):
    scan = load_scan(off(tmp_path / "a.off", header, counts=counts))
    assert_array_equal(scan.vertices, SQUARE_MM)
    assert_array_equal(scan.faces, SQUARE_FACES)


def test_off_polygons_and_face_colours(tmp_path):
    scan = load_scan(off(tmp_path / "a.off", faces=["4 0 1 2 3 255 0 0"]))
    assert_array_equal(scan.faces, SQUARE_FACES)


@pytest.mark.parametrize("top", [1, 255])
def test_coff_vertex_colours(tmp_path, top):
    rows = [
        (*v, *(c / 255 * top for c in color), top)
        for v, color in zip(SQUARE_MM, CORNER_COLORS.values(), strict=True)
    ]
    scan = load_scan(off(tmp_path / "a.off", "COFF", vertices=rows))
    assert_allclose(scan.vertex_color_linear, CORNER_LINEAR, rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"header": "OOF"}, "does not begin with OFF"),
        ({"header": "OFF BINARY"}, "binary OFF is not supported"),
        ({"counts": "5 2 0"}, "declares 2 face rows, but ends before that"),
        ({"counts": "4 3 0"}, "declares 3 face rows, but ends before that"),
        ({"counts": "nan 3 0"}, "counts are not numbers"),
        ({"faces": ["3 0 1 two"]}, "not made of numbers"),
        ({"faces": ["3 0 1"]}, "a list vertex_indices of face is cut short.*no OFF"),
        ({"faces": ["2 0 1"]}, "face 0 has 2 corners, expected at least 3"),
        ({"faces": ["3 0 1 8"]}, "a face refers to vertex 8, but there are 4 vertices"),
        ({"faces": ["3 0 1 1e30"]}, "vertex_indices of face holds 1e.30"),
        ({"faces": ["1e30 0 1 2"]}, "a list vertex_indices of face is cut short"),
        ({"vertices": [(0, 0), (1, 0), (1, 1), (0, 1)]}, "vertex 0 is cut short"),
    ],
)
def test_damaged_off_is_refused_by_name(tmp_path, options, message):
    with pytest.raises(ScanError, match=r"a\.off: .*" + message):
        load_scan(off(tmp_path / "a.off", **options))


def test_numbers_that_signal_are_named_without_a_warning(tmp_path):
    data = bytearray(exported("stl", trimesh.creation.box((100, 100, 100))))
    data[84 + 12 : 84 + 16] = bytes.fromhex("010080ff")  # a signalling NaN
    with pytest.raises(ScanError, match=r"a\.stl: 1 vertices used by faces are NaN"):
        load_scan(written(tmp_path / "a.stl", data))
