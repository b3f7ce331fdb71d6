"""Geometry from one image: derivatives, truth found again, every extreme, bad input."""

from dataclasses import replace
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose, assert_array_equal
from worlds.environments import generated_environment

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import Budget, Meter
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.pinhole import camera_centers, look_at, project
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.geometry.rigid import compose, procrustes, rotation_from_vector, transform_points
from scan2albedo.lighting.harmonics import project_environment
from scan2albedo.reflectance import (
    MorphableShapeModel,
    VertexReflectance,
    refine_geometry,
    reflectance_from_albedo,
    shade_environment,
)
from scan2albedo.reflectance.geometry_terms import (
    GeometryPoint,
    LandmarkTerm,
    PhotometricTerm,
    SmoothImage,
)
from scan2albedo.synthetic import face_shape

SHAPE = (260, 220)
CAMERA = look_at([40.0, 20.0, 900.0], [0.0, 0.0, 0.0], focal_px=1000.0, shape=SHAPE)
AFM = AnnotatedFaceModel.default()
TO_SURFACE = AFM.subdivision(0).matrix
REST, FACES = AFM.surface(0)
LIGHT = project_environment(generated_environment(4))
NO_MARKS = np.full((68, 2), np.nan)


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(0)
    neutral = [TO_SURFACE @ face_shape.person(AFM, rng) for _ in range(40)]
    offsets = [
        TO_SURFACE @ face_shape.person(AFM, rng, strength=0.0, expression=name) - REST
        for name in get_args(face_shape.Expression)[1:]
    ]
    nearest = row_lengths(REST - AFM.landmarks[:, None]).argmin(1)
    return MorphableShapeModel.from_samples(neutral, offsets, FACES, nearest)


RNG = np.random.default_rng(0)
WAVES = np.sin(REST @ RNG.normal(size=(3, 3)) * 0.06 + RNG.uniform(0, 6, 3))
SKIN = reflectance_from_albedo(
    np.array([0.5, 0.35, 0.28]) * (1 + 0.15 * WAVES),
    weights=np.array([0.05, 0.12, 0.08]) * (1 + 0.3 * WAVES),
)
"""Patchy, with highlights."""
LIT = {"reflectance": SKIN, "light": LIGHT}


def portrait(model, seed):
    """A person of none of the model's samples, their picture, and landmarks with 1 px noise."""
    rng = np.random.default_rng([seed, 5])
    name = get_args(face_shape.Expression)[rng.integers(6)]
    shape = TO_SURFACE @ face_shape.person(AFM, rng, expression=name, expression_strength=0.5)
    pose = compose(rotation_from_vector(rng.normal(size=3) * 0.15), rng.normal(size=3) * 10)
    vertices = transform_points(pose, shape)
    normals = vertex_normals(vertices, FACES)
    view = normalized(camera_centers(CAMERA[None])[0] - vertices)
    color = shade_environment(SKIN, normals, view, LIGHT).radiance_linear
    pixels, depth = project(CAMERA, vertices)
    image = interpolate(rasterize(pixels, 1 / depth, FACES, SHAPE), FACES, color)
    image = image + 0.01 * np.median(color) * rng.normal(size=image.shape)
    marks = pixels[model.landmark_vertices] + rng.normal(size=(68, 2))
    return SimpleNamespace(vertices=vertices, image=image, landmarks=marks, pose=pose)


@pytest.fixture(scope="module")
def face(model):
    return portrait(model, 0)


@pytest.fixture(scope="module")
def refine(model, face):
    """`refine_geometry` of a portrait by its landmarks alone, but for what is given."""

    def call(face=face, **changes):
        given = {"image_linear": face.image, "camera": CAMERA, "landmarks_px": face.landmarks}
        return refine_geometry(**given | {"shape_model": model} | changes)

    return call


@pytest.fixture(scope="module")
def alone(refine):
    return refine()


@pytest.fixture(scope="module")
def lit(refine):
    """By colours too."""
    return refine(**LIT)


def vertex_error(vertices, truth):
    """Mean distance in mm after the best similarity: size and distance cannot be told apart in one image."""
    aligned = transform_points(procrustes(vertices, truth, scale=True), vertices)
    return row_lengths(aligned - truth).mean()


@pytest.fixture(autouse=True, scope="module")
def no_smoothing():
    """The pictures are not finer than the mesh, so nothing is to be smoothed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scan2albedo.reflectance.geometry_fit.BLUR_EDGES", 0.0)
        yield


@pytest.fixture(scope="module")
def point(model, face):
    """A state beside the truth, with a term of landmarks and one of colours."""
    used = np.flatnonzero(vertex_normals(face.vertices, FACES)[:, 2] > 0.4)
    part = VertexReflectance(SKIN.diffuse_linear[used], SKIN.weights[used], SKIN.known[used])
    image = SmoothImage(face.image, None, 1.0)
    terms = (
        LandmarkTerm(CAMERA, model.landmark_vertices, face.landmarks, 0.9),
        PhotometricTerm(image, CAMERA, FACES, used, part, LIGHT, 0.5),
    )
    coefficients = 0.3 * np.random.default_rng(3).normal(size=model.components)
    return GeometryPoint(model, face.pose, coefficients, Meter("test", "objective"), terms)


def test_colours_differ_by_the_derivative_when_vertices_move(point):
    photometric, vertices = point.terms[1], point.vertices
    h = 1e-6
    found = photometric.linearized(vertices)
    off = photometric.differences(vertices).ravel()
    assert_allclose(found.slope, found.curvature * off, rtol=1e-12)
    for direction in np.random.default_rng(1).normal(size=(3, *vertices.shape)):
        ahead, behind = (photometric.differences(vertices + s * direction) for s in (h, -h))
        expected = ((ahead - behind) / (2 * h)).ravel()
        assert_allclose(found.jacobian @ direction.ravel(), expected, atol=1e-6)


def test_the_gradient_is_that_of_the_objective_by_pose_and_coefficients(model, point):
    gradient = point.normal_equations().gradient
    assert len(gradient) == 6 + model.components

    for direction in np.random.default_rng(2).normal(size=(4, len(gradient))):
        direction[:3] *= 0.01
        expected = (point.moved(1e-6 * direction).cost - point.moved(-1e-6 * direction).cost) / 2e-6
        assert gradient @ direction == pytest.approx(expected, rel=1e-5, abs=1e-7)


@pytest.mark.slow
def test_photometry_brings_faces_nearer_than_landmarks_alone(model, refine):
    errors = []
    for seed in range(3):
        face = portrait(model, seed)
        landmarks = refine(face)
        both = refine(face, **LIT)
        assert both.converged
        assert both.plan.ran("reflectance.geometry.photometry")
        assert both.photometric_rmse_after < 0.6 * both.photometric_rmse_before
        errors.append(
            [vertex_error(v, face.vertices) for v in (model.mean, landmarks.vertices, both.vertices)]
        )
    mean, landmarks, both = np.mean(errors, axis=0)
    assert landmarks < 0.85 * mean
    assert both < 0.5 * landmarks
    assert both < 0.35


def test_the_result_holds_together(model, face, lit, refine):
    fit = lit
    made = transform_points(fit.scene_from_model, model.at(np.concatenate([fit.identity, fit.expression])))
    assert_allclose(fit.vertices, made, atol=1e-9)
    turn = fit.scene_from_model[:3, :3]
    assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert_array_equal(fit.normals, vertex_normals(fit.vertices, FACES))
    pixels, _ = project(CAMERA, fit.vertices[model.landmark_vertices])
    assert_allclose(fit.landmark_error_px, row_lengths(pixels - face.landmarks))
    assert fit.landmark_rmse_px == pytest.approx(rms(fit.landmark_error_px))
    assert fit.trace.stages == ("reflectance.geometry.landmarks", "reflectance.geometry.photometry")
    again = refine(**LIT)
    assert_array_equal(again.vertices, fit.vertices)


def test_landmarks_alone_descend(refine):
    rows = []
    fit = refine(on_progress=rows.append)
    assert tuple(rows) == fit.trace.rows
    assert (np.diff([row.error for row in fit.trace]) <= 0).all()
    assert fit.landmark_rmse_px < 1.6
    assert fit.photometric_rmse_before is None
    assert not fit.plan.ran("reflectance.geometry.photometry")


def test_exposure_does_not_matter(face, lit, refine):
    other = refine(image_linear=1000 * face.image, reflectance=SKIN, light=1000 * LIGHT)
    assert_allclose(other.vertices, lit.vertices, atol=1e-4)


def test_neither_the_cameras_scale_nor_its_sign_matters(alone, refine):
    assert_allclose(refine(camera=-7 * CAMERA).vertices, alone.vertices, atol=1e-8)


def test_without_landmarks_photometry_goes_on_from_the_pose_given(model, face, refine):
    off = compose(rotation_from_vector([0.01, -0.01, 0.005]), [1.0, -1.0, 0]) @ face.pose
    fit = refine(landmarks_px=NO_MARKS, **LIT, initial_scene_from_model=off)
    assert fit.plan.ran("reflectance.geometry.photometry")
    assert not fit.plan.ran("reflectance.geometry.landmarks")
    assert np.isnan(fit.landmark_error_px).all()
    assert fit.landmark_rmse_px is None
    assert vertex_error(fit.vertices, face.vertices) < 0.8 * vertex_error(model.mean, face.vertices)


def test_a_few_landmarks_are_enough_beside_a_pose(face, refine):
    few = NO_MARKS.copy()
    few[[30, 36]] = face.landmarks[[30, 36]]
    few[8, 0] = 5.0
    fit = refine(landmarks_px=few, initial_scene_from_model=face.pose)
    assert np.flatnonzero(np.isfinite(fit.landmark_error_px)).tolist() == [30, 36]
    assert fit.landmark_rmse_px < 1


def test_a_face_that_looks_away_shows_nothing_and_keeps_its_landmarks_fit(model, face, refine):
    away = face.pose @ compose(rotation_from_vector([0, np.pi, 0]), np.zeros(3))
    pixels, _ = project(CAMERA, transform_points(away, REST)[model.landmark_vertices])
    fit = refine(landmarks_px=pixels, initial_scene_from_model=away, **LIT)
    assert not fit.plan.ran("reflectance.geometry.photometry")
    assert np.isfinite(fit.vertices).all()


CORNER = np.indices(SHAPE).max(0) < 5


@pytest.mark.parametrize(
    "more",
    [
        {"mask": CORNER},
        {"image_linear": np.zeros((*SHAPE, 3))},
        {"light": np.zeros((81, 3))},
        {"light": -LIGHT},
        {"light": 5 * LIGHT},
    ],
    ids=["masked", "black", "no light", "negative light", "strong light"],
)
def test_colours_that_explain_nothing_change_nothing(alone, more, refine):
    lit = refine(**(LIT | more))
    assert_array_equal(lit.vertices, alone.vertices)
    assert not lit.plan.ran("reflectance.geometry.photometry")
    if "light" in more:
        assert lit.photometric_rmse_before > 0.3
    else:
        assert lit.photometric_rmse_after is None


def test_light_of_another_place_is_not_believed_though_it_leads_far(model, refine):
    face = portrait(model, 2)
    other = project_environment(generated_environment(72))
    lit = refine(face, reflectance=SKIN, light=other * LIGHT[0] / other[0])
    assert_array_equal(lit.vertices, refine(face).vertices)
    assert lit.iterations > 50


def test_vertices_without_known_reflectance_are_left_out(refine):
    known = REST[:, 1] > 0
    half = replace(SKIN, known=known)
    fit = refine(reflectance=half, light=LIGHT)
    assert fit.plan.ran("reflectance.geometry.photometry")
    assert np.isfinite(fit.vertices).all()


def test_models_without_directions_move_the_pose_alone(model, face, refine):
    rigid = replace(model, basis=model.basis[:0], identity_components=0)
    fit = refine(shape_model=rigid, **LIT)
    assert_allclose(fit.vertices, transform_points(fit.scene_from_model, model.mean), atol=1e-9)
    expressions = model.basis[model.identity_components :]
    only_expressions = replace(model, basis=expressions, identity_components=0)
    fit = refine(shape_model=only_expressions, **LIT)
    assert fit.identity.shape == (0,)
    assert vertex_error(fit.vertices, face.vertices) < vertex_error(model.mean, face.vertices)


@pytest.mark.parametrize("evaluations", [1, 5, 14])
def test_a_budget_that_ends_gives_the_best_so_far(evaluations, refine):
    budget = Budget(evaluations=evaluations)
    with pytest.warns(RuntimeWarning, match="without having converged"):
        fit = refine(budget=budget, **LIT)
    assert not fit.converged
    assert len(fit.trace) <= evaluations


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"landmarks_px": NO_MARKS, "initial_scene_from_model": np.eye(4)}, ReflectanceError, "undetermined"),
        ({"initial_scene_from_model": 2 * np.eye(4)}, ReflectanceError, "not rigid"),
        ({"landmarks_px": NO_MARKS}, ReflectanceError, "0 landmarks seen, a pose takes 6"),
        (LIT | {"reflectance": reflectance_from_albedo(np.ones((5, 3)))}, ReflectanceError, "topology"),
        (LIT | {"light": LIGHT * np.nan}, ReflectanceError, "NaN"),
        ({"initial_identity": "NaN"}, ReflectanceError, "initial_identity"),
        ({"light": LIGHT}, ValueError, "go together"),
        ({"landmarks_px": np.zeros((5, 2))}, ValueError, "landmarks_px"),
        (LIT | {"image_linear": np.zeros((9, 9))}, ValueError, "image_linear"),
        ({"camera": np.eye(4)}, ValueError, "cameras"),
    ],
)
def test_what_cannot_be_fitted_is_refused(model, change, error, words, refine):
    if "initial_identity" in change:
        change = {"initial_identity": np.full(model.identity_components, np.nan)}
    with pytest.raises(error, match=words):
        refine(**change)
