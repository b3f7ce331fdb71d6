"""A population: what belongs to a person stays, what belongs to a session changes."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from worlds.population import Population, population_scan

from scan2albedo.synthetic import Scanner

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
    assert_array_equal(truth.albedo_linear, later.albedo_linear)
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


def test_same_seed_same_scan_and_another_population_is_another(first):
    scan, _ = first
    same, _ = scanned(0, 0)
    assert_array_equal(scan.vertices, same.vertices)
    assert_array_equal(scan.texture_linear, same.texture_linear)
    _, foreign = population_scan(0, 0, seed=1, population=Population(scanner=SMALL))
    assert foreign.lights != first[1].lights


def test_a_room_has_one_weak_lamp_and_light_of_its_own(first):
    scan, truth = scanned(0, 0, light="room")
    (lamp,) = truth.lights
    assert 0.3 <= lamp.intensity <= 1.0
    assert_array_equal(truth.albedo_linear, first[1].albedo_linear)
    colored, _ = scanned(0, 0, light="room", lamp_colors=0.3)
    bright = scan.texture_linear.min(-1) > 0.1
    tint = np.log(colored.texture_linear[bright] / scan.texture_linear[bright])
    assert (tint[:, 0] - tint[:, 1]).std() > 0.02  # over the surface: no tint of the whole picture
