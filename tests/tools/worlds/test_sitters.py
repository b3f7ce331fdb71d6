"""People of the traced scenes: where hair grows, and how a jaw opens."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds.sitters import Person, fringe, gloss_map, opened, painted, seated, stubble

import scan2albedo as s2a
from scan2albedo.synthetic.textures import landmark_uv

MODEL = s2a.AnnotatedFaceModel.default()
UV = landmark_uv(MODEL)
LANDMARKS = MODEL.landmarks
PLAIN = Person(name="plain", seed=3, tone=0.2)


@pytest.fixture(scope="module")
def sitter():
    return seated(PLAIN, MODEL)


def test_stubble_grows_on_chin_and_jaw_and_upper_lip_alone():
    points = np.array([UV[8] + [0, 0.06], (UV[33] + UV[51]) / 2, UV[57], UV[27], UV[30], UV[19] + [0, 0.1]])
    chin, moustache, lip, bridge, tip, forehead = stubble(points, UV, np.random.default_rng(0))
    assert chin > 0.2
    assert moustache > 0.1
    assert max(lip, bridge, tip, forehead) == pytest.approx(0, abs=0.02)


def test_a_fringe_covers_one_side_of_the_forehead():
    high = UV[19:25:5, 1].max() + 0.19
    across = np.stack([np.linspace(0.1, 0.95, 200), np.full(200, high)], 1)
    cover = fringe(across, UV, np.random.default_rng(0))
    assert cover[:60].mean() > 0.3 > cover[-60:].mean()
    assert fringe(UV[30:36], UV, np.random.default_rng(0)).max() == 0


def test_the_nose_is_oilier_than_the_jaw():
    nose, jaw = gloss_map(np.array([UV[30], UV[4]]), UV, np.random.default_rng(0))
    assert 1 >= nose > 1.5 * jaw > 0


def test_an_open_jaw_lowers_chin_and_lower_lip_and_nothing_above():
    moved = opened(LANDMARKS, LANDMARKS, 12.0) - LANDMARKS
    assert moved[8, 1] < -10
    assert moved[[57, 58], 1].max() < -8
    assert_allclose(moved[[27, 30, 33, 36, 45, 51]], 0, atol=0.5)
    assert_allclose(opened(LANDMARKS, LANDMARKS, 0.0), LANDMARKS, atol=1e-9)


def test_an_open_mouth_keeps_the_mesh_and_lowers_the_landmarks(sitter):
    wide = seated(replace(PLAIN, mouth_deg=12.0), MODEL)
    assert_array_equal(wide.faces, sitter.faces)
    assert_allclose(np.linalg.norm(wide.normals, axis=1), 1, atol=1e-6)
    gap = wide.face.landmarks[62, 1] - wide.face.landmarks[66, 1]
    assert gap > 6
    # The eyes and the hair stay where they were.
    assert_allclose(wide.face.landmarks[36:48], sitter.face.landmarks[36:48], atol=0.6)
    hair = np.unique(sitter.faces[sitter.part == 2])
    assert_array_equal(wide.vertices[hair], sitter.vertices[hair])


def test_stubble_darkens_the_chin_and_nothing_else(sitter):
    points = np.concatenate([UV[[30, 57, 37]], [UV[8] + [0, 0.06]]])
    shaven, grown = (painted(replace(PLAIN, stubble=density), sitter, points) for density in (0.0, 1.0))
    assert ((grown >= 0.01) & (grown <= 0.95)).all()
    change = (grown / shaven).mean(1)
    assert_allclose(change[:3], 1, atol=0.03)
    assert change[3] < 0.9


def test_the_same_person_is_painted_alike_twice(sitter):
    person = replace(PLAIN, stubble=0.5, fringe=0.5, mouth_deg=8.0)
    points = np.random.default_rng(0).uniform(size=(500, 2))
    assert_array_equal(painted(person, sitter, points), painted(person, sitter, points))
