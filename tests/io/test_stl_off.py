import numpy as np
import pytest
import trimesh
from helpers.scan_files import assert_refused
from helpers.square import CORNER_COLORS, CORNER_LINEAR, SQUARE_FACES, SQUARE_MM
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.io import load_scan

SPHERE = trimesh.creation.icosphere(subdivisions=2, radius=80.0)


def exported(kind, mesh=SPHERE):
    data = mesh.export(file_type=kind)
    return data if isinstance(data, bytes) else data.encode()


def written(path, data):
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("kind", "old", "new"),
    [
        ("stl", b"", b""),
        ("stl_ascii", b"endloop\n", b"endloop "),
        ("stl_ascii", b"solid \n", b"solid by # 5 vertex\n"),
        ("stl_ascii", b"solid", b"solid Gesch\xfctz"),  # in no particular encoding
    ],
)
def test_an_stl_of_other_lines_or_that_begins_with_solid_gives_the_same(tmp_path, kind, old, new):
    data = exported(kind)
    assert old in data
    # A binary file may begin with "solid", too.
    changed = b"solid" + data[5:] if kind == "stl" else data.replace(old, new)
    plain, other = (load_scan(written(tmp_path / "a.stl", each)) for each in (data, changed))
    assert_allclose(other.vertices, plain.vertices, rtol=1e-14)
    assert_array_equal(other.faces, plain.faces)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_comes_back_welded(tmp_path, kind):
    scan = load_scan(written(tmp_path / "a.STL", exported(kind)))
    assert scan.vertices.shape == SPHERE.vertices.shape
    corners, true = (np.sort(c.reshape(-1, 9), axis=0) for c in (scan.vertices[scan.faces], SPHERE.triangles))
    assert_allclose(corners, true, atol=1e-4)
    assert f"vertices merged at equal positions (seams): {3 * len(SPHERE.faces) - 162}" in scan.notes


def test_all_solids_of_a_text_stl_are_read(tmp_path):
    other = SPHERE.copy()
    other.apply_translation((300, 0, 0))
    text = b"\n".join(exported("stl_ascii", mesh) for mesh in (SPHERE, other))
    assert len(load_scan(written(tmp_path / "a.stl", text), "mm").faces) == 2 * len(SPHERE.faces)
    cut = written(tmp_path / "b.stl", text[: int(0.8 * len(text))])
    assert_refused(cut, r"b\.stl: .*endsolid.*truncated")


@pytest.mark.parametrize(
    "data", [bytes(84), b"solid\nvertex 0 0\nvertex 1 0\nvertex 1 1\nendsolid\n", b"solid\nendsolid\n"]
)
def test_an_stl_without_triangles_is_refused_by_name(tmp_path, data):
    assert_refused(written(tmp_path / "a.stl", data), r"a\.stl: .*damaged")


def off(path, header="OFF", vertices=SQUARE_MM, faces=("3 0 1 2", "3 0 2 3"), counts=None):
    rows = [" ".join(map(str, vertex)) for vertex in vertices]
    counts = counts or f"{len(rows)} {len(faces)} 0"
    path.write_text("\n".join([header, counts, *rows, *faces]))
    return path


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"header": "# made by hand\nOFF # it is\n\n"},
        {"header": "OFF 4 2 0", "counts": "# counted"},
        {"faces": ["4 0 1 2 3 255 0 0"]},
    ],
)
def test_off(tmp_path, options):
    scan = load_scan(off(tmp_path / "a.off", **options))
    assert_array_equal(scan.vertices, SQUARE_MM)
    assert_array_equal(scan.faces, SQUARE_FACES)


@pytest.mark.parametrize("top", [1, 255])
def test_coff_vertex_colours(tmp_path, top):
    colors = np.array(list(CORNER_COLORS.values())) / 255 * top
    rows = np.column_stack([SQUARE_MM, colors, np.full(4, top)])
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
        ({"faces": ["3 0 1 1e30"]}, "vertex_indices of face holds 1e.30"),
        ({"faces": ["1e30 0 1 2"]}, "a list vertex_indices of face is cut short.*no OFF"),
        ({"vertices": [(0, 0), (1, 0), (1, 1), (0, 1)]}, "vertex 0 is cut short"),
    ],
)
def test_damaged_off_is_refused_by_name(tmp_path, options, message):
    assert_refused(off(tmp_path / "a.off", **options), rf"a\.off: .*{message}")


def test_numbers_that_signal_are_named_without_a_warning(tmp_path):
    data = bytearray(exported("stl", trimesh.creation.box((100, 100, 100))))
    data[84 + 12 : 84 + 16] = bytes.fromhex("010080ff")  # a signalling NaN
    assert_refused(written(tmp_path / "a.stl", data), r"a\.stl: 1 vertices used by faces are NaN")
