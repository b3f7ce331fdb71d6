"""Templates in any axes and unit get the convention's axes, regions and landmarks."""

import igl
import numpy as np
import pytest
from helpers.measures import row_lengths
from helpers.meshes import sphere
from numpy.testing import assert_allclose

import scan2albedo as s2a
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import procrustes, rotation_angle_rad, rotation_from_vector, transform_points

TURN = rotation_from_vector(np.array([1.2, -0.7, 2.0]))
INNER = slice(17, 68)


@pytest.fixture(scope="module")
def own(model):
    """The default model's surface as a template: (vertices mm, faces, its landmarks)."""
    return *model.surface(2), model.landmarks


@pytest.fixture(scope="module")
def turned(own):
    """The same in micrometres, inside out and upside down."""
    vertices, faces, _ = own
    return s2a.AnnotatedFaceModel.from_mesh(1000 * vertices @ TURN.T + 5000, faces[:, ::-1], name="own")


def test_a_turned_template_gets_the_conventions_axes(own, turned):
    vertices, _, _ = own
    carried = turned.template_of(turned.control_vertices)
    assert np.degrees(rotation_angle_rad(procrustes(carried, vertices)[:3, :3])) < 1
    assert any("unit um" in note for note in turned.notes)
    assert any(note.startswith("turned by ") for note in turned.notes)
    back = transform_points(turned.template_from_model, carried)
    assert_allclose(back, 1000 * vertices @ TURN.T + 5000, atol=1e-3)


def test_landmarks_and_regions_are_carried_over(own, turned, model):
    vertices, _, landmarks = own
    model_from_own = procrustes(vertices, turned.template_of(turned.control_vertices))
    error = row_lengths(turned.landmarks - transform_points(model_from_own, landmarks))
    assert error.mean() < 0.5
    centres = turned.control_vertices[turned.control_faces].mean(1)
    near = ClosestPointQuery(transform_points(model_from_own, vertices), model.surface(2)[1]).query(centres)
    parents = model.subdivision(2).parent[near.face]
    same = [turned.in_region(name) & model.in_region(name)[parents] for name in model.regions]
    assert np.any(same, axis=0).mean() > 0.93
    assert turned.regions["nose"].stiffness == model.regions["nose"].stiffness


def test_landmarks_lie_at_the_default_ones_places_on_its_chart(turned, model, tmp_path):
    def places(of):
        points = of.landmark_points
        return np.einsum("nk,nkj->nj", points.barycentric, of.face_uv[of.control_faces[points.face]])

    turned.save(tmp_path / "turned.json")
    back = s2a.AnnotatedFaceModel.load(tmp_path / "turned.json")
    away = places(back) - places(model)
    assert row_lengths(away).max() < 0.04


@pytest.mark.slow
def test_what_is_given_is_kept(own):
    vertices, faces, landmarks = own
    model = s2a.AnnotatedFaceModel.from_mesh(
        vertices, faces, regions={"left": vertices[:, 0] > 0}, landmarks=landmarks
    )
    assert set(model.regions) == {"face", "left"}
    assert row_lengths(model.landmarks + vertices.mean(0) - landmarks).max() < 3
    assert not any("carried over" in note for note in model.notes)


@pytest.mark.slow
def test_a_template_without_a_face_keeps_its_axes_and_says_so():
    vertices, faces = sphere(3, 1.0)
    model = s2a.AnnotatedFaceModel.from_mesh(vertices * [75, 110, 90], faces, control_size=200)
    assert model.landmarks is None
    assert set(model.regions) == {"face"}
    assert "nothing annotated" in model.notes[-1]


@pytest.mark.slow
def test_half_a_face_gets_regions_but_no_landmarks(own):
    vertices, faces, _ = own
    half = faces[(vertices[faces][:, :, 0] > -12).all(1)]
    model = s2a.AnnotatedFaceModel.from_mesh(vertices, half)
    assert model.landmarks is None
    names = {region.index: name for name, region in model.regions.items()}
    assert "left_eye" in {names[int(index)] for index in model.region}
    assert "beside the template" in model.notes[-1]


@pytest.mark.slow
@pytest.mark.parametrize("part", ["inner face", "face area", "whole head"])
def test_the_generic_face_in_metres_and_turned(generic_face, part):
    vertices, faces, landmarks = generic_face(part)
    given = vertices @ TURN.T / 1000
    model = s2a.AnnotatedFaceModel.from_mesh(given, faces)
    found = transform_points(model.template_from_model, model.landmarks) * 1000
    error = row_lengths(found - given[landmarks] * 1000)
    assert error[INNER].mean() < 3
    back = transform_points(model.template_from_model, model.template_of(model.control_vertices))
    assert_allclose(back, given, atol=1e-9)


@pytest.mark.slow
def test_the_mask_of_468_vertices_is_annotated_and_fits_a_scan_in_its_own_topology(shared_data):
    vertices, _, _, faces, _, _ = igl.readOBJ(str(shared_data / "canonical_face_model.obj"))
    model = s2a.AnnotatedFaceModel.from_mesh(vertices @ TURN.T, faces, name="mask")
    assert model.landmarks is not None
    assert any("no opening between the lips" in note for note in model.notes)
    scan = s2a.load_scan(shared_data / "james.obj")
    fitted = s2a.fit(scan, model, s2a.register(scan, model))
    assert fitted.template_vertices.shape == (468, 3)
    truth = transform_points(
        fitted.model_from_scan, np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    )
    assert row_lengths(fitted.landmarks - truth)[INNER].mean() < 5
    assert np.nanmedian(fitted.residual_mm) < 0.4


@pytest.mark.slow
def test_what_closes_the_hole_of_a_mouth_becomes_film(generic_face):
    vertices, faces, _ = generic_face("inner face")
    model = s2a.AnnotatedFaceModel.from_mesh(vertices, faces)
    film = model.in_region("between_lips")
    centres = model.control_vertices[model.control_faces].mean(1)
    mouth = model.landmarks[60:68].mean(0)
    assert film.any()
    assert not any("no opening" in note for note in model.notes)
    assert row_lengths(centres[film] - mouth).max() < 35
