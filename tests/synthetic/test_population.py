"""A population: what belongs to a person stays, what belongs to a session changes."""

import numpy as np
import pytest

from scan2albedo import AnnotatedFaceModel
from scan2albedo.synthetic import Material, Population, Scanner, light_at, population_scan
from scan2albedo.synthetic.face_paint import PaintedFeatures, paint_face
from scan2albedo.synthetic.face_shape import face_geometry_image, face_surface
from scan2albedo.synthetic.population import _painter, _random_lights
from scan2albedo.synthetic.scanner import flash_pictures, two_pods
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.sitter import sit_down

pytestmark = pytest.mark.slow

SMALL = Scanner(spacing_mm=8.0, picture_size=48, size=64)


def scanned(person, session, **choices):
    return population_scan(person, session, population=Population(scanner=SMALL, **choices))


@pytest.fixture(scope="module")
def first():
    return scanned(0, 0)


def test_a_person_keeps_the_skin_and_the_session_has_its_light(first):
    scan, truth = first
    again, later = scanned(0, 1)
    np.testing.assert_array_equal(truth.albedo_linear, later.albedo_linear)
    assert truth.lights != later.lights
    assert scan.name == "person-0-session-0"
    assert again.name == "person-0-session-1"
    # Another pose, and the expression moves the face by a few millimetres at most.
    assert np.abs(truth.model_from_scan - later.model_from_scan).max() > 0.1
    moved = np.linalg.norm(truth.control_points - later.control_points, axis=1)
    assert 0.05 < moved.max() < 8


def test_another_person_has_another_face_and_skin(first):
    _, truth = first
    _, other = scanned(1, 0)
    assert np.linalg.norm(truth.control_points - other.control_points, axis=1).max() > 2
    ratio = np.log(truth.albedo_linear[truth.image.mask] / other.albedo_linear[truth.image.mask])
    assert ratio.std() > 0.05


def test_less_individuality_makes_people_more_alike():
    model, uv = AnnotatedFaceModel.default(), np.random.default_rng(0).uniform(size=(2000, 2))

    def unlike(individuality):
        population = Population(individuality=individuality)
        skins = [
            np.log(_painter(model, np.random.default_rng(k), 0.3, population, [0])(uv)) for k in range(2)
        ]
        return np.abs(skins[0] - skins[1]).mean()

    assert unlike(0.25) == pytest.approx(0.25 * unlike(1.0), rel=1e-6)


def test_same_seed_same_scan_and_another_population_is_another(first):
    scan, _ = first
    same, _ = scanned(0, 0)
    np.testing.assert_array_equal(scan.vertices, same.vertices)
    np.testing.assert_array_equal(scan.texture_linear, same.texture_linear)
    _, foreign = population_scan(0, 0, seed=1, population=Population(scanner=SMALL))
    assert foreign.lights != first[1].lights


def test_lights_stay_in_their_cone_and_apart():
    population = Population(light_cone_deg=40)
    drawn = [_random_lights(np.random.default_rng(k), population) for k in range(300)]
    tilts = [np.degrees(np.arccos(light.direction[2])) for lights in drawn for light in lights]
    assert max(tilts) <= 40
    assert max(tilts) > 38
    two = [lights for lights in drawn if len(lights) == 2]
    assert 110 < len(two) < 190
    assert all(a.direction @ b.direction < np.cos(np.deg2rad(30)) for a, b in two)


def test_light_of_several_colors_adds_up():
    model, lights = AnnotatedFaceModel.default(), (light_at(30), light_at(-40))
    sitter = sit_down(0, expression="neutral", model=model)
    pods = two_pods(sitter.face.vertices.mean(0), reach_mm=150.0)

    def pictured(colors):
        rng = np.random.default_rng(0)
        finish = Material(0.3, 0.1, 14.0)
        return flash_pictures(sitter, pods, lights, finish, size=32, noise=0, rng=rng, colors=colors)

    (plain, exposure), (white, same) = pictured(None), pictured(np.ones((3, 3)))
    assert same == pytest.approx(exposure, rel=1e-6)
    np.testing.assert_allclose(white, plain, atol=0.02)  # a step of 8 bits
    _, brighter = pictured(np.full((3, 3), 0.5))
    assert brighter == pytest.approx(2 * exposure, rel=1e-6)
    red, _ = pictured(np.array([[1.0, 1, 1], [3.0, 1, 1], [1, 1, 1]]))
    lit = (plain.min(-1) > 0.05) & (red.min(-1) > 0.02)
    ratio = np.log(red[lit][:, 0] / red[lit][:, 1]) - np.log(plain[lit][:, 0] / plain[lit][:, 1])
    assert ratio.max() > 0.5  # in the red lamp's light
    assert np.percentile(ratio, 5) < 0.15  # in its shadow


def test_a_room_has_one_weak_lamp_and_light_of_its_own(first):
    scan, truth = scanned(0, 0, light="room")
    (lamp,) = truth.lights
    assert 0.3 <= lamp.intensity <= 1.0
    np.testing.assert_array_equal(truth.albedo_linear, first[1].albedo_linear)
    colored, _ = scanned(0, 0, light="room", lamp_colors=0.3)
    bright = scan.texture_linear.min(-1) > 0.1
    tint = np.log(colored.texture_linear[bright] / scan.texture_linear[bright])
    assert (tint[:, 0] - tint[:, 1]).std() > 0.02  # over the surface: no tint of the whole picture


def test_brows_and_lips_take_their_own_form():
    model = AnnotatedFaceModel.default()
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


@pytest.mark.parametrize(
    "wrong",
    [
        {"individuality": 0.0},
        {"light": "sun"},
        {"individuality": 1.5},
        {"lamp_colors": -0.1},
        {"light_cone_deg": 120.0},
        {"tones": (0.5, 0.2)},
    ],
)
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Population(**wrong)
