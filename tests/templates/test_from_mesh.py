from functools import partial

import numpy as np
import pytest
import trimesh
from helpers.face_mask import mask_surface
from helpers.measures import row_lengths
from helpers.meshes import sphere
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo import AnnotatedFaceModel
from scan2albedo.errors import ModelError
from scan2albedo.face_model.annotation import surface_frames
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import boundary_loops, face_areas, face_cross_products
from scan2albedo.geometry.parametrization import signed_areas

plain_model = partial(AnnotatedFaceModel.from_mesh, annotate=False)
"""The domes below are not faces, so nothing is to be recognised in them."""
small_model = partial(plain_model, control_size=300)


def without_disc(vertices, faces, x, y, radius):
    """The faces without those whose centre lies within `radius` mm of (x, y)."""
    return faces[row_lengths(vertices[faces].mean(1)[:, :2] - [x, y]) > radius]


def assert_sound(model):
    assert len(boundary_loops(model.control_faces)) == 1
    assert (signed_areas(model.uv, model.control_faces) > 0).all()
    assert model.uv.min() >= 0
    assert model.uv.max() <= 1


@pytest.fixture(scope="module")
def dense():
    vertices, faces = mask_surface(40)
    return vertices, faces, small_model(vertices, faces)


def test_a_dense_template_gets_a_small_control_mesh_whose_limit_surface_follows_it(dense):
    vertices, _, model = dense
    assert 250 <= len(model.control_vertices) <= 400
    assert_sound(model)
    error = ClosestPointQuery(*model.surface(3)).query(vertices - vertices.mean(0)).distance
    assert error.mean() < 0.08
    assert error.max() < 2.0


def test_the_template_comes_back_exactly_at_rest_and_turns_with_the_surface(dense):
    vertices, faces, model = dense
    carried = model.template_of(model.control_vertices)
    assert_allclose(carried, vertices - vertices.mean(0), atol=1e-9)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert_allclose(model.template_of(model.control_vertices @ turn.T + 5), carried @ turn.T + 5, atol=1e-9)
    assert_array_equal(model.template_faces, faces)


@pytest.mark.parametrize(("unit", "factor"), [("cm", 0.1), ("m", 0.001)])
def test_the_unit_is_decided_by_the_size_of_a_head(dense, unit, factor):
    vertices, faces, model = dense
    other = small_model(factor * vertices, faces)
    assert_allclose(other.control_vertices, model.control_vertices, atol=1e-6)


def test_a_small_template_keeps_its_own_vertices():
    vertices, faces = mask_surface(16)
    model = plain_model(vertices, faces)
    assert len(model.control_vertices) == 256
    assert_array_equal(model.control_faces, faces)


def test_eye_holes_are_filled_named_and_loose_parts_carried_along():
    vertices, faces = mask_surface(40)
    holed = without_disc(vertices, without_disc(vertices, faces, 30, 30, 10), -30, 30, 10)
    eyeball = np.array([[30.0, 30, 40], [32, 30, 40], [30, 32, 40]])
    count = len(vertices)
    model = plain_model(
        np.concatenate([vertices, eyeball]),
        np.concatenate([holed, [[count, count + 1, count + 2]]]),
        control_size=400,
    )
    assert_sound(model)
    filled = model.region == model.regions["filled"].index
    centre = model.control_vertices[model.control_faces[filled]].mean(1)
    assert np.ptp(np.sign(centre[:, 0])) == 2
    area = face_areas(model.control_vertices, model.control_faces)[filled].sum()
    assert 300 < area < 3 * 2 * np.pi * 100
    carried = model.template_of(model.control_vertices)
    assert carried.shape == (count + 3, 3)
    assert_allclose(carried[count:] - carried[0], eyeball - vertices[0], atol=1e-6)


def test_seams_with_doubled_vertices_are_welded():
    vertices, faces = mask_surface(24)
    left = vertices[faces, 0].mean(1) < 0
    count = len(vertices)
    model = plain_model(
        np.concatenate([vertices, vertices]), np.where(left[:, None], faces, faces + count), control_size=200
    )
    assert_sound(model)
    carried = model.template_of(model.control_vertices)
    both = np.intersect1d(faces[left], faces[~left])
    assert_allclose(carried[both], carried[both + count], atol=1e-6)


def test_an_inside_out_template_is_turned(dense):
    vertices, faces, _ = dense
    model = small_model(vertices, faces[:, ::-1])
    assert face_cross_products(model.control_vertices, model.control_faces)[:, 2].sum() > 0


def test_a_closed_head_is_cut_open_at_the_back():
    vertices, faces = sphere(3, 1.0)
    model = plain_model(vertices * [75, 110, 90], faces, control_size=200)
    assert_sound(model)
    assert np.ptp(model.control_vertices[:, 2]) < 160


def test_a_given_chart_is_kept_and_a_folded_one_replaced(dense):
    vertices, faces, _ = dense
    uv = 0.1 + 0.8 * (vertices[:, :2] - vertices[:, :2].min(0)) / np.ptp(vertices[:, :2], axis=0)
    model = small_model(vertices, faces, uv)
    assert_sound(model)
    expected = 0.1 + 0.8 * (model.control_vertices[:, :2] / [140, 190] + 0.5)
    assert_allclose(model.uv, expected, atol=0.02)
    assert_sound(small_model(vertices, faces, np.abs(uv - 0.5) + 0.2))


def test_regions_by_indices_and_masks(dense):
    vertices, faces, _ = dense
    left = vertices[:, 0] > 5
    low = vertices[faces][:, :, 1].mean(1) < -40
    model = small_model(vertices, faces, regions={"left": np.flatnonzero(left), "low": low})
    centre = model.control_vertices[model.control_faces].mean(1)
    names = {r.index: r.name for r in model.regions.values()}
    for spot, name in (([40, 40], "left"), ([-40, 40], "face"), ([-40, -70], "low")):
        nearest = np.argmin(row_lengths(centre[:, :2] - spot))
        assert names[int(model.region[nearest])] == name


def test_landmarks_by_points_and_by_vertices(dense):
    vertices, faces, _ = dense
    chosen = np.arange(68) * 20 + 101
    by_index = small_model(vertices, faces, landmarks=chosen)
    by_point = small_model(0.1 * vertices, faces, landmarks=0.1 * vertices[chosen])
    assert_allclose(by_point.landmarks, by_index.landmarks, atol=1e-6)
    assert row_lengths(by_index.landmarks - (vertices - vertices.mean(0))[chosen]).mean() < 0.2


def test_a_few_faces_that_spoil_the_surface_are_dropped(dense):
    vertices, faces, model = dense
    fin = np.concatenate([faces, [[*faces[1000, :2], 100]]])
    mended = small_model(vertices, fin)
    assert_array_equal(mended.control_faces, model.control_faces)
    assert any(note.startswith("faces dropped at edges") for note in mended.notes)
    pinched = np.where(faces == faces[1000, 0], faces[2000, 0], faces)
    assert_sound(small_model(vertices, pinched))


def test_what_cannot_be_used_is_refused_with_the_reason():
    vertices, faces = mask_surface(12)
    every_edge_thrice = np.concatenate([faces, np.roll(faces, 7, axis=0) * [1, 1, 0] + [0, 0, 77]])
    ring = trimesh.creation.torus(80.0, 30.0, major_sections=16, minor_sections=16)
    bitten = ring.faces[row_lengths(ring.triangles_center - [80, 0, 30]) > 25]
    cases = [
        (vertices[:, :2], faces, "shape"),
        (vertices, faces[:0], "point cloud"),
        (vertices, faces + 5, f"refer to vertices 5 to {faces.max() + 5} of"),
        (vertices, faces - 1, "refer to vertices -1 to"),
        (vertices, every_edge_thrice, "more than two faces"),
        (ring.vertices, bitten, "disc"),
    ]
    for v, f, message in cases:
        with pytest.raises(ModelError, match=message):
            plain_model(v, f)


def test_wrong_annotations_are_refused_with_the_reason():
    vertices, faces = mask_surface(12)
    for extra, message in (
        ({"uv": np.zeros((3, 2))}, "uv has shape"),
        ({"landmarks": np.zeros((51, 3))}, "68"),
        ({"landmarks": np.full(68, 999)}, "out of range"),
        ({"landmarks": np.r_[-1, np.arange(67)]}, "landmark vertex -1 out of range"),
        ({"landmarks": vertices[:68] + 500}, "mm from the template"),
        ({"landmarks": np.r_[vertices[:67], [[0, np.nan, 0]]]}, "landmark 67 is NaN"),
        ({"landmarks": np.r_[vertices[:67], [[0, 0, 400.0]]]}, "landmark 67 lies"),
        ({"regions": {"nose": np.array([0, 5000])}}, "'nose'"),
        ({"regions": {"nose": np.array([0, -1])}}, "'nose'"),
        ({"regions": {"filled": np.array([0])}}, "'filled' is taken"),
    ):
        with pytest.raises(ModelError, match=message):
            plain_model(vertices, faces, **extra)


def test_surface_frames_are_orthonormal_and_finite_on_zero_area():
    corners = np.random.default_rng(0).normal(size=(20, 3, 3))
    frames = surface_frames(corners)
    assert_allclose(np.einsum("nij,nik->njk", frames, frames), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12)
    assert np.isfinite(surface_frames(np.zeros((1, 3, 3)))).all()
