"""The judge of the door: outcomes, bins of confidence, spreads of poses."""

import numpy as np
import pytest
from bench.door import (
    Answer,
    Reliability,
    Scene,
    about_their_mean,
    judged_face,
    judged_other,
    plainly,
)
from worlds.door import Case, relief
from worlds.objects import random_body, random_relief, wrong_object, wrong_objects

from scan2albedo import RawScan
from scan2albedo.geometry.rigid import compose, rotation_from_vector

SCAN = RawScan(*random_body(np.random.default_rng(0)))


@pytest.fixture(scope="module")
def face(model):
    return Scene(Case(SCAN, ("plain",), compose(np.eye(3), [1.0, 2.0, 3.0]), model.landmarks))


def turned(scene, vector, shift=(0, 0, 0), **answer):
    pose = compose(rotation_from_vector(np.deg2rad(vector)), shift) @ scene.scan.model_from_scan
    return Answer(pose, **{"sure": 0.9, **answer})


@pytest.mark.parametrize(
    ("vector", "shift", "ended"),
    [
        ((0, 0, 0), (0, 0, 0), ""),
        ((0, 9, 0), (0, 0, 0), ""),
        ((0, 11, 0), (0, 0, 0), "wrong"),
        ((0, 0, 0), (0, 16, 0), "wrong"),
        ((0, 175, 0), (0, 0, 0), "wrong"),
    ],
)
def test_a_pose_is_judged_by_its_turn_and_the_landmarks(face, vector, shift, ended):
    row = judged_face(face, turned(face, vector, shift))
    assert row["right %"] == row["pose right %"] == 100 * (not ended)
    assert row["sure misses %"] == 100 * bool(ended)
    if ended:
        assert row["ended"].startswith(ended)
    else:
        assert row["deg"] == pytest.approx(np.linalg.norm(vector))


@pytest.mark.parametrize(
    ("answer", "let_in"),
    [
        (Answer(np.eye(4), 0.4), False),
        (Answer(np.eye(4), 0.6), True),
        (Answer(np.eye(4), None), True),
        (Answer(None, 0.9, "no face found"), False),
    ],
)
def test_what_shows_no_face_is_let_in_by_a_confident_pose(answer, let_in):
    assert judged_other(Scene(Case(SCAN, ("body",))), answer)["let in %"] == 100 * let_in


def test_a_refusal_counts_with_the_confidence_and_the_pose_of_its_error(face):
    plain = judged_face(face, Answer(None, None, "no face found"))
    assert (plain["refused %"], plain["pose right %"]) == (100, 100)
    assert np.isnan(plain["confidence"])
    wrong = judged_face(face, turned(face, (0, 90, 0), sure=0.3, message="no face found"))
    assert (wrong["refused %"], wrong["confidence"], wrong["pose right %"]) == (100, 0.3, 0)


def test_a_refusal_is_an_answer():
    assert plainly(SCAN).message


def test_reliability_compares_each_bins_confidence_with_its_share():
    pairs = [(0.85, k % 5 != 0) for k in range(40)] + [(1.0, True)] * 30 + [(0.15, True)] * 3
    found = Reliability.of(*np.array(pairs, float).T)
    assert found.count.tolist() == [0, 3, 0, 0, 0, 0, 0, 0, 40, 30]
    assert found.confidence[8] == pytest.approx(0.85)
    assert found.share[8] == pytest.approx(0.8)
    # The bin of three scans, which is off by 0.85, is too small to count.
    assert found.largest_gap == pytest.approx(0.05)
    assert found.mean_gap == pytest.approx((40 * 0.05 + 3 * 0.85) / 73)


def test_poses_are_compared_with_their_mean_at_the_face():
    face = np.array([0.0, 0.0, 50.0])
    poses = [
        compose(rotation, face - rotation @ face + [shift, 0, 0])
        for rotation, shift in ((rotation_from_vector([0, a, 0]), s) for a, s in ((-0.02, -3), (0.02, 3)))
    ]
    np.testing.assert_allclose(
        about_their_mean(poses, face), [[np.degrees(0.02), 3], [np.degrees(0.02), 3]], rtol=1e-6
    )


def test_reliefs_differ_and_come_again(shared_data):
    first, second = relief(0), relief(2)
    assert not np.allclose(first.scan.vertices, second.scan.vertices)
    assert np.array_equal(first.scan.vertices, relief(0).scan.vertices)
    vertices, faces = random_relief(np.random.default_rng(1))
    corner = vertices[faces]
    upward = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2]
    assert (upward > 0).all()


def test_there_are_forty_three_objects_of_a_hands_to_a_heads_size(shared_data):
    assert len(wrong_objects()) == 43
    for number in (0, 20, 42):
        _, scan = wrong_object(number)
        assert 80 < np.ptp(scan.vertices, axis=0).max() < 500
