"""Transferred expressions: exact on linear shapes, near on fitted faces."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import scan2albedo as s2a
from scan2albedo.applications import (
    FaceMesh,
    TransferOptions,
    load_result,
    personal_model,
    transfer_expression,
)
from scan2albedo.applications.expression_transfer import expression_displacement, laid_on_what_is_still
from scan2albedo.cli.commands import app
from scan2albedo.errors import ApplicationError
from scan2albedo.face_model import chosen_model
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points

SMILE = "mouthSmile_L_mouthSmile_R"
BAR_MM = 1.5


@pytest.fixture(scope="module")
def measured(shared_data):
    """Shapes in dense correspondence as meshes of the face area."""
    with np.load(shared_data / "ict_faces.npz") as data:
        count, triangles = int(data["face_area_vertices"]), int(data["face_area_faces"])
        faces = data["faces"][:triangles].astype(np.int64)
        return {
            name.removeprefix("shape_"): FaceMesh(
                data[name][:count].astype(float), faces, np.zeros((count, 2))
            )
            for name in data
            if name.startswith("shape_")
        }


@pytest.mark.parametrize(
    ("options", "bar_mm"),
    [
        (TransferOptions(align=False), 1e-4),
        (TransferOptions(), 0.05),
    ],
)
def test_a_smile_of_measured_faces(measured, options, bar_mm):
    generic, smile = measured["generic_neutral"], measured[f"generic_{SMILE}"]
    other, truth = measured["person2"], measured[f"person2_{SMILE}"].vertices
    made = other.vertices + expression_displacement(generic, smile, options=options)
    error = np.linalg.norm(made - truth, axis=1).mean()
    assert error <= bar_mm < BAR_MM
    assert np.linalg.norm(other.vertices - truth, axis=1).mean() > 2


def test_alignment_undoes_a_pose_between_the_scans(measured):
    rest, smile = measured["generic_neutral"].vertices, measured[f"generic_{SMILE}"].vertices
    pose = compose(rotation_from_vector([0.03, -0.02, 0.04]), [2.0, -1.0, 3.0])
    placed = laid_on_what_is_still(transform_points(pose, smile), rest)
    assert np.linalg.norm(placed - smile, axis=1).mean() < 0.05


def test_the_face_moves_as_its_mesh_does_and_keeps_its_skin(person):
    a, smiling, b = person(0), person(0, "smile"), person(1)
    made = transfer_expression(a, smiling, b, options=TransferOptions(align=False))
    mask = b.mask
    moved = made.image.position[mask] - b.image.position[mask]
    expected = smiling.image.position[mask] - a.image.position[mask]
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    assert np.linalg.norm(moved, axis=1).max() > 3
    np.testing.assert_allclose(np.linalg.norm(made.image.normal[mask], axis=1), 1, atol=1e-9)
    still = np.linalg.norm(moved, axis=1) < 1e-3
    np.testing.assert_array_equal(made.albedo_linear, b.albedo_linear)
    assert made.reflectance == b.reflectance
    assert np.abs(made.image.normal[mask] - b.image.normal[mask])[~still].max() > 0.05
    # The shadows of the moved surface are its own.
    np.testing.assert_allclose(made.image.occluder_mesh()[0], made.mesh.vertices)


def test_no_expression_changes_nothing(person):
    a, b = person(0), person(1)
    made = transfer_expression(a, a, b)
    np.testing.assert_allclose(made.image.position, b.image.position, atol=1e-6)
    np.testing.assert_allclose(made.image.normal, b.image.normal, atol=1e-6)


def test_strength_scales_it(person):
    a, smiling, b = person(0), person(0, "smile"), person(1)
    full, half = (
        transfer_expression(a, smiling, b, options=TransferOptions(strength=s)).image.position
        for s in (1.0, 0.5)
    )
    np.testing.assert_allclose(full - b.image.position, 2 * (half - b.image.position), atol=1e-9)


def test_a_personal_model_is_the_person_on_the_same_chart(result):
    model = personal_model(result.fitted)
    given = result.fitted.model
    np.testing.assert_array_equal(model.control_vertices, result.fitted.control_points)
    np.testing.assert_array_equal(model.uv, given.uv)
    assert model.name == given.name


def test_a_personal_model_of_files_is_that_of_the_fit(result, stored, tmp_path):
    rng = np.random.default_rng(0)
    control = result.fitted.control_points + rng.normal(0, 2, result.fitted.control_points.shape)
    subdivision = result.fitted.model.subdivision(1)
    fitted = replace(result.fitted, control_points=control, vertices=subdivision.matrix @ control)
    face = load_result(stored)
    face = replace(face, mesh=replace(face.mesh, vertices=fitted.vertices))
    ours, theirs = personal_model(face), personal_model(fitted)
    np.testing.assert_allclose(ours.control_vertices, theirs.control_vertices, atol=1e-8)
    ours.save(tmp_path / "person.json")
    loaded = s2a.AnnotatedFaceModel.load(tmp_path / "person.json")
    np.testing.assert_array_equal(loaded.control_vertices, ours.control_vertices)
    np.testing.assert_allclose(loaded.landmarks, fitted.model.landmarks_of(control), atol=1e-8)


def test_the_command_writes_a_model_that_process_takes(result, stored, tmp_path):
    out = tmp_path / "person.json"
    done = CliRunner().invoke(app, ["personal-model", str(stored), "-o", str(out)])
    assert done.exit_code == 0, done.output
    model = chosen_model(out)
    np.testing.assert_allclose(model.control_vertices, result.fitted.control_points, atol=1e-8)
    assert model.name == result.fitted.model.name


def test_a_personal_model_needs_the_model_of_the_fit(result, stored, person):
    face, model = load_result(stored), result.fitted.model
    with pytest.raises(ApplicationError, match="processed with the model 'default annotated face model'"):
        personal_model(face, replace(model, name="mine"))
    with pytest.raises(ApplicationError, match="none of the model"):
        personal_model(replace(person(0), model_name=model.name))
    bent = replace(face.mesh, vertices=face.mesh.vertices + np.random.default_rng(0).normal(0, 1, (1, 3)))
    personal_model(replace(face, mesh=bent))
    crumpled = face.mesh.vertices + np.random.default_rng(0).normal(0, 1, face.mesh.vertices.shape)
    with pytest.raises(ApplicationError, match="none of the model"):
        personal_model(replace(face, mesh=replace(face.mesh, vertices=crumpled)))


@pytest.mark.parametrize(
    "wrong",
    [{"strength": np.nan}, {"correspondence": "guessed"}],
)
def test_options_are_checked(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        TransferOptions(**wrong)
