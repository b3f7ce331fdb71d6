"""Path-traced people: one person in all sessions, other people other, the same lamps where it says so."""

import numpy as np
import pytest
from benchmarks.scan_files import DATA
from recognition_experiment import traced_people
from recognition_experiment.traced_people import SESSIONS, Heads, TracedPerson, rig_of, session_shape

pytestmark = pytest.mark.skipif(
    not (DATA / "ict_faces.npz").is_file(), reason="../shared/data/ict_faces.npz is not there"
)


@pytest.fixture(scope="module")
def heads():
    return Heads.read()


def test_people_differ_in_shape_and_albedo(heads, monkeypatch):
    monkeypatch.setattr(traced_people, "_TEXTURE", (80, 128))
    ann, again, bob = (TracedPerson.random(heads, person, 5) for person in (0, 0, 1))
    np.testing.assert_array_equal(ann.shape, again.shape)
    np.testing.assert_array_equal(ann.albedo, again.albedo)
    assert np.linalg.norm(ann.shape - bob.shape, axis=1).mean() > 2
    assert 0.05 < np.abs(np.log(ann.albedo / bob.albedo)).mean() < 0.8
    assert 0 < ann.albedo.min() < ann.albedo.max() < 1


def test_an_expression_moves_the_face_alone(heads):
    someone = TracedPerson(heads.generic, np.ones((2, 2, 3)))
    random = np.random.default_rng(0)
    np.testing.assert_array_equal(session_shape(heads, someone, "neutral", random), heads.generic)
    moved = np.linalg.norm(session_shape(heads, someone, "expression", random) - heads.generic, axis=1)
    assert moved[heads.landmarks].max() > 0.5
    assert moved[heads.generic[:, 2] < -40].max() < 0.1


def test_the_last_session_has_the_lamps_of_the_first():
    lights = [light for light, _ in SESSIONS]
    assert lights[0] == lights[3]
    first, last = (rig_of("studio", np.random.default_rng(seed)) for seed in (0, 1))
    assert first == last
    assert rig_of("flash", np.random.default_rng(0)) != rig_of("flash", np.random.default_rng(1))
