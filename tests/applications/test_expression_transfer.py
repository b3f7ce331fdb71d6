"""Transferred expressions: exact on linear shapes, near on fitted faces."""

from dataclasses import replace

import numpy as np
import pytest
from bench.applications import carried, carried_errors, fitted, measured_pair, mesh_of
from helpers.cli import invoke
from helpers.commands import succeeded
from helpers.fits import fit_of
from helpers.measures import row_lengths
from numpy.testing import assert_allclose, assert_array_equal

import scan2albedo as s2a
from scan2albedo.applications import (
    FaceMesh,
    TransferOptions,
    load_result,
    personal_model,
    transfer_expression,
)
from scan2albedo.applications.expression_transfer import (
    TWO_PEOPLE_MM,
    apart_where_still,
    expression_displacement,
    laid_on_what_is_still,
    refined_expression,
    refinement_level,
)
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.synthetic import face_shape
from scan2albedo.templates import chosen_model

SMILE = "mouthSmile_L_mouthSmile_R"


@pytest.fixture(scope="module")
def measured(shared_data):
    """Shapes in dense correspondence as meshes of the face area."""
    with np.load(shared_data / "ict_faces.npz") as data:
        count, faces = int(data["face_area_vertices"]), data["faces"][: int(data["face_area_faces"])]
        shapes = {name: data[name][:count].astype(float) for name in data if name.startswith("shape_")}
    return {
        name.removeprefix("shape_"): FaceMesh(vertices, faces.astype(np.int64), vertices[:, :2])
        for name, vertices in shapes.items()
    }


def test_a_smile_of_measured_faces(measured):
    generic, smile = measured["generic_neutral"], measured[f"generic_{SMILE}"]
    other, truth = measured["person2"], measured[f"person2_{SMILE}"].vertices
    made = other.vertices + expression_displacement(generic, smile)
    assert row_lengths(made - truth).mean() <= 0.05
    assert row_lengths(other.vertices - truth).mean() > 2


def test_alignment_undoes_a_pose_between_the_scans(measured):
    rest, smile = measured["generic_neutral"].vertices, measured[f"generic_{SMILE}"].vertices
    pose = compose(rotation_from_vector([0.03, -0.02, 0.04]), [2.0, -1.0, 3.0])
    placed = laid_on_what_is_still(transform_points(pose, smile), rest)
    assert row_lengths(placed - smile).mean() < 0.05


def test_two_people_lie_apart_even_where_an_expression_leaves_the_face_still(measured):
    pairs = {
        ("generic_neutral", f"generic_{SMILE}"): False,
        ("generic_neutral", "generic_jawOpen0.7"): False,
        ("person2", f"person2_{SMILE}"): False,
        ("person1", "person3"): True,
        ("person4", f"person2_{SMILE}"): True,
        ("generic_neutral", "person3_browInnerUp_L_browInnerUp_R_jawOpen0.5"): True,
    }
    for (rest, moved), two in pairs.items():
        assert (apart_where_still(measured[rest], measured[moved]) > TWO_PEOPLE_MM) == two
    mesh = synthetic(3)
    slipped = replace(mesh, vertices=slid(synthetic(3, "smile"), 1.5))
    assert apart_where_still(mesh, slipped) < TWO_PEOPLE_MM


def test_the_face_moves_as_its_mesh_does_and_keeps_its_skin(person):
    a, smiling, b = person(0), person(0, "smile"), person(1)
    made = transfer_expression(a, smiling, b)
    mask = b.mask
    moved = (made.image.position - b.image.position)[mask]
    placed = laid_on_what_is_still(smiling.image.position[mask], a.image.position[mask])
    assert_allclose(moved, placed - a.image.position[mask], atol=1e-9)
    assert row_lengths(moved).max() > 3
    assert_allclose(row_lengths(made.image.normal[mask]), 1, atol=1e-9)
    assert_array_equal(made.albedo_linear, b.albedo_linear)
    assert made.reflectance == b.reflectance
    moves = row_lengths(moved) >= 1e-3
    assert np.abs(made.image.normal - b.image.normal)[mask][moves].max() > 0.05
    # The shadows of the moved surface are its own.
    assert_allclose(made.image.occluder_mesh()[0], made.mesh.vertices)
    half = transfer_expression(a, smiling, b, options=TransferOptions(strength=0.5))
    assert_allclose(moved, 2 * (half.image.position - b.image.position)[mask], atol=1e-9)
    # No expression changes nothing.
    same = transfer_expression(a, a, b).image
    assert_allclose(same.position, b.image.position, atol=1e-6)
    assert_allclose(same.normal, b.image.normal, atol=1e-6)


def test_a_personal_model_of_files_is_that_of_the_fit(result, stored, tmp_path):
    given, rng = result.fitted.model, np.random.default_rng(0)
    control = given.control_vertices + rng.normal(0, 2, given.control_vertices.shape)
    fitted = fit_of(given, control)
    theirs = personal_model(fitted)
    assert_array_equal(theirs.control_vertices, control)
    assert_array_equal(theirs.uv, given.uv)
    assert theirs.name == given.name
    face = load_result(stored)
    ours = personal_model(replace(face, mesh=replace(face.mesh, vertices=fitted.vertices)))
    assert_allclose(ours.control_vertices, control, atol=1e-8)
    ours.save(tmp_path / "person.json")
    loaded = s2a.AnnotatedFaceModel.load(tmp_path / "person.json")
    assert_array_equal(loaded.control_vertices, ours.control_vertices)
    assert_allclose(loaded.landmarks, given.landmarks_of(control), atol=1e-8)


def test_the_command_writes_a_model_that_process_takes(result, stored, tmp_path):
    out = tmp_path / "person.json"
    succeeded(invoke("personal-model", stored, "-o", out))
    model = chosen_model(out)
    assert_allclose(model.control_vertices, result.fitted.control_points, atol=1e-8)
    assert model.name == result.fitted.model.name


def test_a_personal_model_needs_the_model_of_the_fit(result, stored, person):
    face, model = load_result(stored), result.fitted.model
    with pytest.raises(ApplicationError, match="processed with the model 'default annotated face model'"):
        personal_model(face, replace(model, name="mine"))

    def moved(*shape):
        off = np.random.default_rng(0).normal(0, 1, shape)
        return replace(face, mesh=replace(face.mesh, vertices=face.mesh.vertices + off))

    personal_model(moved(3))
    for other in (replace(person(0), model_name=model.name), moved(*face.mesh.vertices.shape)):
        with pytest.raises(ApplicationError, match="none of the model"):
            personal_model(other)


@pytest.mark.parametrize("wrong", [{"strength": np.nan}, {"correspondence": "guessed"}])
def test_options_are_checked(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        TransferOptions(**wrong)


MODEL = s2a.AnnotatedFaceModel.default()
LEVEL = 2


def synthetic(seed, expression="neutral"):
    control_points = face_shape.person(MODEL, np.random.default_rng(seed), expression=expression)
    subdivision = MODEL.subdivision(LEVEL)
    vertices = subdivision.matrix @ control_points
    return FaceMesh(vertices, subdivision.faces, vertices[:, :2])


def slid(mesh, mm):
    """The same surface with its vertices moved along it, up to `mm` sideways and downward."""
    x, y, _ = mesh.vertices.T
    off = mm * np.stack([np.sin(y / 25), np.cos(x / 25), np.zeros(len(x))], 1)
    return surface_query(mesh.vertices, mesh.faces).query(mesh.vertices + off).points


def test_the_level_of_a_mesh_is_found(person, result, stored):
    for level in (0, 1, 2):
        vertices, faces = MODEL.surface(level)
        assert refinement_level(FaceMesh(vertices, faces, vertices[:, :2]), MODEL) == level
    turned = FaceMesh(vertices, faces[:, [1, 2, 0]], vertices[:, :2])
    for mesh in (turned, person(0).mesh):
        assert refinement_level(mesh, MODEL) is None
    assert refinement_level(load_result(stored).mesh, result.fitted.model) == result.fitted.levels


def test_what_slid_is_set_right_and_no_expression_stays_none():
    rest, expression = synthetic(1), synthetic(1, "surprise")
    truth, moved = expression.vertices, slid(expression, 3.0)
    found = refined_expression(rest, moved, MODEL, LEVEL)
    before, after = (row_lengths(points - truth).mean() for points in (moved, found))
    assert before > 1.5
    assert after < 0.35 * before
    skin = ~MODEL.in_region("between_lips")[MODEL.subdivision(LEVEL).parent]
    used = np.unique(rest.faces[skin])
    assert surface_query(truth, rest.faces).query(found[used]).distance.mean() < 0.05
    none = expression_displacement(rest, rest, options=TransferOptions(correspondence="refined"))
    assert np.abs(none).max() < 1e-6


def test_what_cannot_be_refined_is_told_and_left_by_default(person):
    a, smiling, b = person(0), person(0, "smile"), person(1)

    def transferred(**options):
        return transfer_expression(a, smiling, b, options=TransferOptions(**options)).image.position

    with pytest.raises(ApplicationError, match=r"not on the mesh of 'default.*give the model"):
        transferred(correspondence="refined")
    assert_array_equal(transferred(), transferred(correspondence="as-fitted"))


def carried_without_chin(pair, correspondence):
    """As `carried`, of an expression whose scan ends above the chin."""
    faces = pair.faces[pair.moving[pair.faces].mean(1)[:, 1] >= -60]
    a, moving = fitted(pair.a, pair.faces, pair.model), fitted(pair.moving, faces, pair.model)
    options = TransferOptions(correspondence=correspondence)
    return expression_displacement(mesh_of(a), mesh_of(moving), options=options, model=pair.model)


@pytest.mark.slow
@pytest.mark.usefixtures("shared_data")
@pytest.mark.parametrize(
    ("move", "bar_mm", "transfer"),
    [
        ("smile", 1.2, carried),
        ("left smile", 0.8, carried),
        ("jaw", 1.5, carried),
        ("smile", 1.2, carried_without_chin),
    ],
)
def test_expressions_from_scans(move, bar_mm, transfer):
    """Mean distance of measured points of another face, moved by the new expression, to where they belong."""
    pair = measured_pair("generic_neutral", move, "person2", own_model=False)
    refined, as_fitted = (
        carried_errors(pair, transfer(pair, correspondence))["mean mm"]
        for correspondence in ("refined", "as-fitted")
    )
    assert refined < min(bar_mm, 0.9 * as_fitted)
