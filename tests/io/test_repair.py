import numpy as np
import pytest
from helpers.meshes import sphere
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as arrays
from numpy.testing import assert_array_equal

from scan2albedo.errors import ScanError
from scan2albedo.io.parsed_mesh import Material, ParsedMesh
from scan2albedo.io.repair import first_equal_row, repair, require_usable

VERTICES, FACES = sphere(2, 80.0)


SHAPES = st.tuples(st.integers(1, 40), st.just(3))


@given(
    arrays.arrays(np.float64, SHAPES, elements=st.sampled_from([-0.0, 0.0, 1.0, 2.0]))
    | arrays.arrays(np.int64, SHAPES, elements=st.integers(-2, 2))
)
def test_equal_rows_are_found_as_a_slow_search_finds_them(rows):
    slow = [next(j for j in range(len(rows)) if (rows[j] == rows[i]).all()) for i in range(len(rows))]
    assert first_equal_row(rows).tolist() == slow


def test_each_fault_is_mended_and_told():
    seam = np.concatenate([VERTICES, VERTICES[:2], [[999, 999, 999]]])  # two repeats and one loose vertex
    faces = FACES.copy()
    faces[faces < 2] += len(VERTICES)
    faults = np.array([FACES[3], FACES[5, [1, 2, 0]], FACES[7, ::-1], [4, 4, 9], [10, 11, 10]])
    faces = np.concatenate([faces, faults])
    uv = np.arange(len(faces) * 6, dtype=float).reshape(-1, 3, 2)
    color = np.arange(len(seam) * 3, dtype=np.float32).reshape(-1, 3)
    mesh = ParsedMesh(seam, faces, uv, np.arange(len(faces)), (Material("a"),), color, ("first",))
    fixed = repair(mesh)
    assert_array_equal(fixed.vertices, VERTICES)
    assert_array_equal(fixed.faces, FACES)
    assert_array_equal(fixed.uv, uv[: len(FACES)])
    assert_array_equal(fixed.material, np.arange(len(FACES)))
    assert_array_equal(fixed.vertex_color_linear, color[: len(VERTICES)])
    assert fixed.notes == (
        "first",
        "vertices merged at equal positions (seams): 2",
        "zero-area faces dropped: 2",
        "duplicate faces dropped: 3",
        "unreferenced vertices dropped: 1",
    )
    assert mesh.vertices is seam  # inputs are not mutated
    assert len(mesh.faces) == len(FACES) + 5


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_slivers_go_and_thin_triangles_stay_at_any_scale(scale, offset):
    sliver = np.array([[0.0, 0, 0], [1, 1, 1], [3, 3, 3]])
    thin = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0]]) + 10
    vertices = np.concatenate([sliver, thin]) * scale + offset * scale
    fixed = repair(ParsedMesh(vertices, np.arange(6).reshape(2, 3)))
    assert len(fixed.faces) == 1
    assert_array_equal(fixed.vertices, vertices[3:])


def test_a_clean_mesh_stays_as_it_is_and_broken_vertices_count_only_when_faces_use_them():
    fixed = repair(ParsedMesh(VERTICES, FACES))
    assert fixed.notes == ()
    assert_array_equal(fixed.vertices, VERTICES)
    assert_array_equal(fixed.faces, FACES)
    vertices = np.concatenate([VERTICES, [[np.nan, 0, 0]]])
    assert len(repair(ParsedMesh(vertices, FACES)).vertices) == len(VERTICES)
    require_usable(ParsedMesh(vertices, FACES), "a.obj")
    vertices[[5, 9], 1] = np.inf, 1e200
    told = r"a\.obj: 2 vertices used by faces are NaN or infinite .*, the first is vertex 5 "
    with pytest.raises(ScanError, match=told):
        require_usable(ParsedMesh(vertices, FACES), "a.obj")
