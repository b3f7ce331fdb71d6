from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.eyeglasses import angle_deg
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import ModelError
from scan2albedo.face_model.variation import EXPRESSION_BUMPS, IDENTITY_BUMPS, displacement
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.geometry.rasterization import rasterize_uv
from scan2albedo.synthetic import Material, face, hemisphere, light_at
from scan2albedo.synthetic.face_shape import face_geometry_image, face_surface, person, with_relief
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.textures import PaintedFeatures, landmark_uv, paint_face


@pytest.fixture(scope="module")
def bare_model(model):
    return replace(model, landmark_points=None, name="bare")


def test_nobody_in_particular_is_the_model_at_rest(model):
    same = person(model, np.random.default_rng(0), strength=0.0)
    assert_allclose(same, model.control_vertices, atol=1e-9)


@pytest.mark.parametrize("expression", sorted(EXPRESSION_BUMPS))
def test_people_differ_by_millimetres_and_stay_aligned(model, expression):
    rest = model.control_vertices
    shapes = [person(model, np.random.default_rng(s), expression=expression) for s in range(4)]
    for shape in shapes:
        moved = row_lengths(shape - rest)
        assert 0.7 < moved.mean() < 6
        assert moved.max() < 20
        # Rigidly aligned: no translation or first-order rotation is left.
        assert_allclose((shape - rest).mean(0), 0, atol=1e-9)
        assert_allclose(np.cross(rest - rest.mean(0), shape - rest).mean(0), 0, atol=1e-6)
    assert row_lengths(shapes[0] - shapes[1]).mean() > 0.7


def test_a_smile_lifts_and_widens_the_mouth(model):
    plain, smile = (
        model.landmarks_of(person(model, np.random.default_rng(1), expression=e))
        for e in ("neutral", "smile")
    )
    assert smile[48, 1] > plain[48, 1] + 1.5
    assert smile[54, 0] - smile[48, 0] > plain[54, 0] - plain[48, 0] + 4


def test_paired_modes_are_mirror_symmetric(model):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3)) * 50
    for bump in IDENTITY_BUMPS:
        there = displacement(bump, points, model.landmarks)
        mirrored = displacement(bump, points * [-1, 1, 1], model.landmarks)
        if bump.paired or bump.direction[0] == 0:
            atol = 0.02 * np.abs(bump.direction).max() + 1e-3
            assert_allclose(mirrored, there * [-1, 1, 1], rtol=1e-5, atol=atol)


def test_unknown_expression_and_missing_landmarks_are_refused(model, bare_model):
    with pytest.raises(ValueError, match=r"'grin'.*'smile'"):
        person(model, np.random.default_rng(0), expression="grin")
    with pytest.raises(ModelError, match="bare"):
        person(bare_model, np.random.default_rng(0))
    with pytest.raises(ModelError, match="bare"):
        landmark_uv(bare_model)


def test_texels_lie_where_the_models_chart_says(model):
    control = person(model, np.random.default_rng(3))
    image = face_geometry_image(model, face_surface(model, control), 64)
    raster = rasterize_uv(model.uv, model.control_faces, 64)
    assert_array_equal(image.mask, raster.covered)
    on_surface = SurfacePoints(raster.face[image.mask], raster.barycentric[image.mask])
    expected = model.subdivision(3).points_matrix(on_surface) @ control
    assert_allclose(image.position[image.mask], expected, atol=1e-9)
    assert np.mean(image.region[image.mask] == model.region[raster.face[image.mask]]) > 0.999
    assert np.all(image.region[~image.mask] == 255)
    right, up = image.position[[32, 31], [33, 32]] - image.position[32, 32]
    across = np.cross(right, up)
    assert across @ image.normal[32, 32] > 0.9 * np.linalg.norm(across)


@pytest.mark.parametrize(
    "make", [hemisphere, *(partial(face, 2, texture=texture) for texture in ("plain", "skin", "wood"))]
)
def test_texture_is_albedo_times_shading_plus_highlights(make):
    scene = make(size=96, bits=None, material=Material(0.3, 0.2, 15.0))
    made = scene.albedo_linear * scene.shading[..., None] + scene.specular[..., None]
    assert_allclose(scene.image.texture_linear, made * scene.gain, atol=1e-6)
    assert scene.image.texture_linear.max() == pytest.approx(0.98, abs=1e-6)
    assert scene.specular.max() > 0.1
    assert np.all(scene.shading[scene.image.mask] >= 1)


def test_the_nose_casts_a_shadow_on_the_far_cheek():
    scene = face(0, size=128, lights=[light_at(-60)])
    cast = scene.shadow[..., 0] & (scene.image.normal @ scene.lights[0].direction > 0.15)
    x, y, _ = np.moveaxis(scene.image.position, -1, 0)
    level = scene.image.mask & (np.abs(y) < 25)
    assert cast[level & (x > 8) & (x < 35)].mean() > 0.2
    assert cast[level & (x < -25)].mean() < 0.01


def test_same_seed_same_scene_and_expressions_keep_the_skin():
    first, again = face(4, size=64), face(4, size=64)
    assert_array_equal(first.image.texture_linear, again.image.texture_linear)
    smiling, other = face(4, expression="smile", size=64), face(5, size=64)
    assert_array_equal(first.albedo_linear, smiling.albedo_linear)
    assert np.abs(first.image.position - smiling.image.position).max() > 2
    assert not np.array_equal(first.albedo_linear, other.albedo_linear)


def test_brows_are_dark_lips_are_red_and_eyes_are_white(model):
    marks = landmark_uv(model)
    cheeks = marks[[[2, 31], [14, 35]]].mean(1)
    eye = marks[36] * 0.7 + marks[39] * 0.3
    places = np.concatenate([cheeks, marks[[57, 51]], marks[[19, 24]] - [0, 0.006], [eye]])
    people = [paint_face(places, model, np.random.default_rng(seed)) for seed in range(6)]
    cheek, lip, brow, white = np.split(np.mean(people, 0), [2, 4, 6])
    assert (lip[:, 0] / lip[:, 1]).mean() > 1.3 * (cheek[:, 0] / cheek[:, 1]).mean()
    assert brow.mean() < 0.6 * cheek.mean()
    assert white.min() > 0.4


def test_relief_is_fine_and_small(model):
    smooth = face_surface(model, model.control_vertices)
    rough = with_relief(smooth, np.random.default_rng(0), height_mm=0.1)
    assert rms(row_lengths(rough.vertices - smooth.vertices)) == pytest.approx(0.1, rel=0.1)
    assert 1 < rms(angle_deg(rough.normals, smooth.normals)) < 8


@pytest.mark.slow
def test_brows_and_lips_take_their_own_form(model):
    image = face_geometry_image(model, face_surface(model, model.control_vertices), 128)
    uv = texel_coordinates(128)[image.mask.ravel()]

    def painted(**features):
        return paint_face(uv, model, np.random.default_rng(0), tone=0.2, features=PaintedFeatures(**features))

    plain = painted()
    for features, darker in (
        ({"brow_thickness": 1.4}, True),
        ({"brow_reach": 0.7}, False),
        ({"lip_fullness": 0.006}, True),
    ):
        change = painted(**features).mean(1) - plain.mean(1)
        assert (change.sum() < 0) == darker
        assert 10 < (np.abs(change) > 0.03).sum() < 0.05 * len(uv)
    lifted = painted(brow_lift=0.02).mean(1) - plain.mean(1)
    assert uv[lifted < -0.1, 1].mean() > uv[lifted > 0.1, 1].mean() + 0.01
