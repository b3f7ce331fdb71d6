"""Ranks, ties, closed sets, and probes of unknown persons."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import cmc_curve, identify_by_similarity, roc_curve

NAMES = ["bob", "ann", "bob"]
SCORES = np.array([[0.1, 0.5, 0.9], [0.3, 0.6, 0.2], [0.4, 0.2, 0.3]])


def test_several_images_of_a_person_count_by_best_or_mean():
    names, scores = ["bob", "ann", "bob", "ann"], [[0.1, 0.5, 0.9, 0.6]]
    for combine, similarities, predicted, rank in (
        ("best", [0.6, 0.9], "bob", 2),
        ("mean", [0.55, 0.5], "ann", 1),
    ):
        found = identify_by_similarity(scores, names, ["ann"], combine=combine)
        assert found.persons == ("ann", "bob")
        assert_allclose(found.similarities, [similarities])
        assert (found.predicted, found.ranks.tolist()) == ((predicted,), [rank])
    with pytest.raises(ValueError, match="expected 'best' or 'mean'"):
        identify_by_similarity(scores, names, ["ann"], combine="worst")


def test_ties_count_against_the_right_person():
    names = ["ann", "bob", "cy"]
    scores = [[0.5, 0.5, 0.1], [0.9, 0.3, 0.3], [0.1, 0.2, 0.9], [0.4, 0.4, 0.9]]
    found = identify_by_similarity(scores, names, ["bob", "cy", "cy", "cy"])
    assert found.ranks.tolist() == [2, 3, 1, 1]
    assert found.predicted == ("ann", "ann", "cy", "cy")
    assert found.rate(2) == 0.75


def test_named_probes_are_as_in_a_closed_set():
    persons = ["ann", None, "bob"]
    found = identify_by_similarity(SCORES, NAMES, persons)
    closed = identify_by_similarity(SCORES[[0, 2]], NAMES, ["ann", "bob"])
    assert found.persons == closed.persons == ("ann", "bob")
    assert found.ranks.tolist() == [2, 0, 1]
    assert found.ranks[found.known].tolist() == closed.ranks.tolist()
    assert_array_equal(found.similarities[found.known], closed.similarities)
    assert found.rate(1) == closed.rate(1) == 0.5
    assert_array_equal(cmc_curve(found).rate, cmc_curve(closed).rate)
    assert_array_equal(roc_curve(found).low, roc_curve(closed).low)


def test_everybody_is_taken_for_somebody_and_the_next():
    found = identify_by_similarity(SCORES, NAMES, [None] * 3)
    assert not found.known.any()
    assert found.predicted == ("bob", "ann", "bob")
    assert found.order.tolist() == [[1, 0], [0, 1], [1, 0]]
    assert_allclose(found.similarities.max(1), [0.9, 0.6, 0.4])
    assert not found.ranks.any()
    for curve in (cmc_curve, roc_curve):
        with pytest.raises(RecognitionError, match="no probe's person is known"):
            curve(found)


HOLE = np.where(SCORES == 0.3, np.nan, SCORES)


@pytest.mark.parametrize(
    ("scores", "gallery", "probes", "error", "words"),
    [
        (np.zeros((1, 0)), [], [None], RecognitionError, "gallery is empty"),
        (np.zeros((0, 1)), ["ann"], [], RecognitionError, "no probe"),
        (np.zeros((1, 2)), NAMES, [None], ValueError, r"expected \(1, 3\): probes by gallery images"),
        (HOLE, NAMES, [None] * 3, RecognitionError, r"probe 1 \(nobody named\) and .* 0 \(bob\) is nan"),
        (SCORES, NAMES, [None, "zoe", None], RecognitionError, r"probe 1 \(zoe\); .*add their images"),
        (np.zeros((7, 1)), ["ann"], list("bcdefgh"), RecognitionError, "and 2 more"),
    ],
)
def test_what_cannot_be_matched_is_refused(scores, gallery, probes, error, words):
    with pytest.raises(error, match=words):
        identify_by_similarity(scores, gallery, probes)
