"""Path-traced people: one person in all sessions, other people other, the same lamps where it says so."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from worlds.light_stage import LightStage
from worlds.traced_sessions import SESSIONS, TracedPerson, Unrolled, rig_of, session_shape


@pytest.fixture(scope="module")
def stage(shared_data):
    return LightStage.load()


def test_people_differ_in_shape_and_albedo(stage):
    head = Unrolled(stage, (80, 128))
    ann, again, bob = (TracedPerson.random(head, person, 5) for person in (0, 0, 1))
    assert_array_equal(ann.shape, again.shape)
    assert_array_equal(ann.albedo, again.albedo)
    assert np.linalg.norm(ann.shape - bob.shape, axis=1).mean() > 2
    assert 0.05 < np.abs(np.log(ann.albedo / bob.albedo)).mean() < 0.8
    assert 0 < ann.albedo.min() < ann.albedo.max() < 1


def test_an_expression_moves_the_face_alone(stage):
    generic, random = stage.shapes["generic_neutral"], np.random.default_rng(0)
    assert_array_equal(session_shape(stage, generic, "neutral", random), generic)
    moved = np.linalg.norm(session_shape(stage, generic, "mixed", random) - generic, axis=1)
    assert moved[stage.landmarks].max() > 0.5
    assert moved[generic[:, 2] < -40].max() < 0.1


def test_the_last_session_has_the_lamps_of_the_first():
    lights = [light for light, _ in SESSIONS]
    assert lights[0] == lights[3]
    first, last = (rig_of("studio", np.random.default_rng(seed)) for seed in (0, 1))
    assert first == last
    assert rig_of("flash", np.random.default_rng(0)) != rig_of("flash", np.random.default_rng(1))
