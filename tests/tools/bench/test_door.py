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
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.geometry.rigid import compose, rotation_from_vector

SCAN = RawScan(*random_body(np.random.default_rng(0)))


@pytest.fixture(scope="module")
def face(model):
    return Scene(Case(SCAN, ("plain",), compose(np.eye(3), [1.0, 2.0, 3.0]), model.landmarks))


def turned(scene, degrees, high_mm, sure=0.9, message=""):
    turn = rotation_from_vector([0, np.deg2rad(degrees), 0])
    return Answer(compose(turn, [0, high_mm, 0]) @ scene.scan.model_from_scan, sure, message)


@pytest.mark.parametrize(
    ("degrees", "high_mm", "right"),
    [(9, 0, True), (11, 0, False), (0, 16, False), (175, 0, False)],
)
def test_a_pose_is_judged_by_its_turn_and_the_landmarks(face, degrees, high_mm, right):
    row = judged_face(face, turned(face, degrees, high_mm))
    assert row["right %"] == row["pose right %"] == 100 * right
    assert row["sure misses %"] == 100 * (not right)
    if right:
        assert row["deg"] == pytest.approx(degrees)
    else:
        assert row["ended"].startswith("wrong")


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
    wrong = judged_face(face, turned(face, 90, 0, 0.3, "no face found"))
    assert (wrong["refused %"], wrong["confidence"], wrong["pose right %"]) == (100, 0.3, 0)


def test_a_refusal_is_an_answer():
    assert plainly(SCAN).message


def test_reliability_compares_each_bins_confidence_with_its_share():
    right = np.arange(73) % 5 != 0
    right[40:] = True
    found = Reliability.of(np.repeat([0.85, 1.0, 0.15], [40, 30, 3]), right.astype(float))
    assert found.count.tolist() == [0, 3, 0, 0, 0, 0, 0, 0, 40, 30]
    assert found.confidence[8] == pytest.approx(0.85)
    assert found.share[8] == pytest.approx(0.8)
    # The bin of three scans, which is off by 0.85, is too small to count.
    assert found.largest_gap == pytest.approx(0.05)
    assert found.mean_gap == pytest.approx((40 * 0.05 + 3 * 0.85) / 73)


def test_poses_are_compared_with_their_mean_at_the_face():
    face, poses = np.array([0.0, 0.0, 50.0]), []
    for sign in (-1, 1):
        rotation = rotation_from_vector([0, sign * np.deg2rad(2), 0])
        poses.append(compose(rotation, face - rotation @ face + [sign * 3, 0, 0]))
    np.testing.assert_allclose(about_their_mean(poses, face), [[2, 3]] * 2, rtol=1e-6)


def test_reliefs_differ_and_come_again(shared_data):
    first, again, other = (relief(seed).scan.vertices for seed in (0, 0, 2))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)
    assert (face_normals(*random_relief(np.random.default_rng(1)))[:, 2] > 0).all()


def test_there_are_forty_three_objects_of_a_hands_to_a_heads_size(shared_data):
    assert len(wrong_objects()) == 43
    for number in (0, 20, 42):
        _, scan = wrong_object(number)
        assert 80 < np.ptp(scan.vertices, axis=0).max() < 500
