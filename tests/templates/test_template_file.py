"""Templates from mesh files."""

import numpy as np
import pytest
from helpers.meshes import obj_text
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo import AnnotatedFaceModel
from scan2albedo.errors import ModelError
from scan2albedo.templates.from_mesh import DenseTemplate, corner_uv, vertex_uv


@pytest.fixture(scope="module")
def obj(tmp_path_factory, model):
    """The default model's control mesh as an OBJ with texture coordinates, its last vertex unused."""
    path = tmp_path_factory.mktemp("template") / "mine.obj"
    vertices = np.concatenate([model.control_vertices, [[0, 0, 0]]])
    path.write_text(obj_text(vertices, model.control_faces, model.uv))
    return path


@pytest.mark.slow
def test_order_and_chart_are_the_files(obj, model):
    made = AnnotatedFaceModel.from_file(obj)
    assert made.name == "mine"
    assert len(made.template_points.face) == len(model.control_vertices) + 1
    assert_array_equal(made.template_faces, model.control_faces)
    assert_allclose(made.template_uv, model.uv[model.control_faces], atol=1e-12)
    assert np.abs(made.uv - model.uv).mean() < 0.01
    coarse = AnnotatedFaceModel.from_file(obj, control_size=300)
    assert 200 < len(coarse.control_vertices) < 400


def test_a_vertex_with_two_texture_coordinates_has_none():
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    uv = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    vertices = np.zeros((5, 3))

    def given(corners):
        return DenseTemplate(vertices, faces, corners, None, None, "mine")

    assert_array_equal(vertex_uv(given(uv[faces]))[:4], uv)
    assert_array_equal(corner_uv(given(uv[faces]))[0], uv[faces])
    seam = uv[faces]
    seam[1, 0] = [0.5, 0.5]
    assert vertex_uv(given(seam)) is None
    assert_array_equal(corner_uv(given(seam))[0], seam)
    gaps = given(np.full((2, 3, 2), np.nan))
    assert vertex_uv(gaps) is None
    beyond, flat = given(seam - 2), given(0 * seam)
    for useless, why in ((gaps, "2 faces have no"), (beyond, "beyond the tiles"), (flat, "the same")):
        found, note = corner_uv(useless)
        assert found is None
        assert why in note
    with pytest.raises(ModelError, match=r"uv has shape \(1, 3, 2\), expected \(2, 3, 2\)"):
        vertex_uv(given(seam[:1]))


@pytest.mark.parametrize("text", [None, "", "hello\n", "v 0 0 0\n"])
def test_a_file_without_a_template_or_that_is_missing_is_refused_by_name(tmp_path, text):
    path = tmp_path / "mine.obj"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ModelError, match="mine"):
        AnnotatedFaceModel.from_file(path)
