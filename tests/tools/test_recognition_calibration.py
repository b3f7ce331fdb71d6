"""The calibration of recognition: its pairs, its shares, and what several sets of people make of it."""

import numpy as np
import pytest
from build.recognition_calibration import KINDS, Judged, calibrated_on, verified

from scan2albedo.recognition import Calibration


def test_scans_of_one_sitting_are_no_pair():
    judged = Judged({"albedo": np.zeros((4, 4))}, list("aabb"), ["a0", "a0", "b0", "b1"], ["1"] * 4)
    (rows, _), own = judged.pairs
    assert len(rows) == 5
    assert own.sum() == 1
    assert judged.part("b").persons == ["b", "b"]


def test_pairs_are_counted():
    people = list("aabbcc")
    same = np.array(people)[:, None] == people
    judged = Judged({"albedo": np.where(same, 0.9, 0.5)}, people, list("012345"), ["1", "2"] * 3)
    even = Calibration(("albedo",), (0.9,), (0.5,), ((0.01,),))
    assert verified(judged, ["albedo"], even) == (1.0, 0.0, 3, 12)


def test_a_calibration_comes_from_all_sets():
    random, people = np.random.default_rng(0), list("aabbccdd")
    same = np.array(people)[:, None] == people

    def noisy(apart, level, kinds=KINDS):
        noise = 0.02 * random.standard_normal((len(kinds), 8, 8))
        found = dict(zip(kinds, level + apart * same + noise + noise.transpose(0, 2, 1), strict=True))
        return Judged(found, people, list("01234567"), ["1", "2"] * 4)

    without_shape = ("albedo", "texture", "shading")
    found = calibrated_on([noisy(0.4, 0.4, without_shape), noisy(0.2, 0.5), noisy(0.3, 0.45)])
    apart = dict(zip(found.kinds, np.subtract(found.same, found.other), strict=True))
    assert apart["albedo"] == pytest.approx(0.3, abs=0.04)
    assert apart["shape"] == pytest.approx(0.25, abs=0.04)
    # Half-way between the means all three sets lie at .6: nothing but noise is added.
    assert found.covariance[0][0] == pytest.approx(2 * 0.02**2, rel=0.8)
    assert found.shading_variance == pytest.approx(2 * 0.02**2, rel=0.5)
    far = calibrated_on([noisy(0.2, 0.3), noisy(0.2, 0.5)])
    assert far.covariance[0][1] == pytest.approx(0.02, rel=0.2)
    assert far.shape_variance == pytest.approx(0.02, rel=0.4)
