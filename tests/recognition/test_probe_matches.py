"""Probes of known and unknown persons."""

import numpy as np
import pytest

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import identify_by_similarity, match_probes

NAMES = ["bob", "ann", "bob"]
SCORES = np.array([[0.1, 0.5, 0.9], [0.3, 0.6, 0.2], [0.4, 0.2, 0.3]])


def test_named_probes_are_as_in_a_closed_set():
    persons = ["ann", None, "bob"]
    found = match_probes(SCORES, NAMES, persons)
    closed = identify_by_similarity(SCORES[[0, 2]], NAMES, ["ann", "bob"])
    assert found.persons == closed.persons == ("ann", "bob")
    assert found.ranks.tolist() == [2, 0, 1]
    assert found.named.ranks.tolist() == closed.ranks.tolist()
    np.testing.assert_array_equal(found.named.similarities, found.similarities[[0, 2]])


def test_everybody_is_taken_for_somebody_and_the_next():
    found = match_probes(SCORES, NAMES, [None] * 3)
    assert found.named is None
    assert found.predicted() == ("bob", "ann", "bob")
    assert found.predicted(2) == ("ann", "bob", "ann")
    np.testing.assert_allclose(found.similarity(), [0.9, 0.6, 0.4])
    np.testing.assert_allclose(found.similarity(2), [0.5, 0.3, 0.2])
    assert not found.ranks.any()


def test_means_and_ties():
    found = match_probes(SCORES, NAMES, [None] * 3, combine="mean")
    np.testing.assert_allclose(found.similarity(), [0.5, 0.6, 0.35])
    assert found.predicted()[0] == "ann"  # 0.5 each: the first in the alphabet
    with pytest.raises(ValueError, match="expected 'best' or 'mean'"):
        match_probes(SCORES, NAMES, [None] * 3, combine="worst")


def test_what_cannot_be_matched_is_refused():
    with pytest.raises(RecognitionError, match="gallery is empty"):
        match_probes(np.zeros((1, 0)), [], [None])
    with pytest.raises(RecognitionError, match="no probe"):
        match_probes(np.zeros((0, 1)), ["ann"], [])
    with pytest.raises(ValueError, match="probes by gallery images"):
        match_probes(np.zeros((1, 2)), NAMES, [None])
    with pytest.raises(RecognitionError, match=r"probe 1 \(nobody named\) and .* 0 \(bob\) is nan"):
        match_probes(np.where(SCORES == 0.3, np.nan, SCORES), NAMES, [None] * 3)
    with pytest.raises(RecognitionError, match="no image of the person"):
        match_probes(SCORES, NAMES, ["zoe", None, None])
