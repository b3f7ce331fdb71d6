"""Ranks, ties, closed sets, and probes of unknown persons."""

import numpy as np
import pytest

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import albedo_templates, cmc_curve, identify, identify_by_similarity, roc_curve

NAMES = ["bob", "ann", "bob"]
SCORES = np.array([[0.1, 0.5, 0.9], [0.3, 0.6, 0.2], [0.4, 0.2, 0.3]])


def test_persons_are_found_through_noise_and_shifts(albedo):
    random = np.random.default_rng(0)
    names = [f"p{k}" for k in range(8)]
    albedos = [albedo(k) for k in range(8)]
    gallery = albedo_templates(albedos, names)
    seen = [0.8 * np.roll(a, (2, -1), (0, 1)) + 0.05 * random.standard_normal(a.shape) for a in albedos]
    found = identify(gallery, albedo_templates(seen[::-1], names[::-1]))
    assert found.predicted == tuple(names[::-1])
    assert found.rate(1) == 1
    assert found.similarities.shape == (8, 8)
    assert found.genuine.sum() == 8


def test_several_images_of_a_person_count_by_best_or_mean():
    names = ["bob", "ann", "bob", "ann"]
    scores = [[0.1, 0.5, 0.9, 0.6]]
    best = identify_by_similarity(scores, names, ["ann"])
    assert best.persons == ("ann", "bob")
    np.testing.assert_allclose(best.similarities, [[0.6, 0.9]])
    assert best.predicted == ("bob",)
    assert best.ranks.tolist() == [2]
    mean = identify_by_similarity(scores, names, ["ann"], combine="mean")
    np.testing.assert_allclose(mean.similarities, [[0.55, 0.5]])
    assert mean.predicted == ("ann",)
    with pytest.raises(ValueError, match="expected 'best' or 'mean'"):
        identify_by_similarity(scores, names, ["ann"], combine="worst")


def test_ties_count_against_the_right_person():
    names = ["ann", "bob", "cy"]
    scores = [[0.5, 0.5, 0.1], [0.9, 0.3, 0.3], [0.1, 0.2, 0.9], [0.4, 0.4, 0.9]]
    found = identify_by_similarity(scores, names, ["bob", "cy", "cy", "cy"])
    assert found.ranks.tolist() == [2, 3, 1, 1]
    assert found.predicted == ("ann", "ann", "cy", "cy")
    assert found.rate(2) == 0.75


def test_a_probe_of_nobody_in_the_gallery_is_named():
    with pytest.raises(RecognitionError, match=r"probe 1 \(zoe\); .*add their images"):
        identify_by_similarity(np.zeros((2, 1)), ["ann"], ["ann", "zoe"])
    with pytest.raises(RecognitionError, match="and 2 more"):
        identify_by_similarity(np.zeros((7, 1)), ["ann"], list("bcdefgh"))


def test_empty_sets_are_refused(albedo):
    templates = albedo_templates([albedo(0)], ["ann"])
    with pytest.raises(RecognitionError, match="gallery is empty"):
        identify(templates.select([]), templates)
    with pytest.raises(RecognitionError, match="no probe was given"):
        identify(templates, templates.select([]))
    with pytest.raises(ValueError, match=r"expected \(1, 2\)"):
        identify_by_similarity([[0.5]], ["ann", "bob"], ["ann"])


def test_named_probes_are_as_in_a_closed_set():
    persons = ["ann", None, "bob"]
    found = identify_by_similarity(SCORES, NAMES, persons)
    closed = identify_by_similarity(SCORES[[0, 2]], NAMES, ["ann", "bob"])
    assert found.persons == closed.persons == ("ann", "bob")
    assert found.ranks.tolist() == [2, 0, 1]
    assert found.ranks[found.known].tolist() == closed.ranks.tolist()
    np.testing.assert_array_equal(found.similarities[found.known], closed.similarities)
    assert found.rate(1) == closed.rate(1) == 0.5
    np.testing.assert_array_equal(cmc_curve(found).rate, cmc_curve(closed).rate)
    np.testing.assert_array_equal(roc_curve(found).low, roc_curve(closed).low)


def test_everybody_is_taken_for_somebody_and_the_next():
    found = identify_by_similarity(SCORES, NAMES, [None] * 3)
    assert not found.known.any()
    assert found.predicted == ("bob", "ann", "bob")
    assert found.order.tolist() == [[1, 0], [0, 1], [1, 0]]
    np.testing.assert_allclose(found.similarities.max(1), [0.9, 0.6, 0.4])
    assert not found.ranks.any()
    for curve in (cmc_curve, roc_curve):
        with pytest.raises(RecognitionError, match="no probe's person is known"):
            curve(found)


def test_means_and_ties():
    found = identify_by_similarity(SCORES, NAMES, [None] * 3, combine="mean")
    np.testing.assert_allclose(found.similarities.max(1), [0.5, 0.6, 0.35])
    assert found.predicted[0] == "ann"  # 0.5 each: the first in the alphabet
    with pytest.raises(ValueError, match="expected 'best' or 'mean'"):
        identify_by_similarity(SCORES, NAMES, [None] * 3, combine="worst")


def test_what_cannot_be_matched_is_refused():
    with pytest.raises(RecognitionError, match="gallery is empty"):
        identify_by_similarity(np.zeros((1, 0)), [], [None])
    with pytest.raises(RecognitionError, match="no probe"):
        identify_by_similarity(np.zeros((0, 1)), ["ann"], [])
    with pytest.raises(ValueError, match="probes by gallery images"):
        identify_by_similarity(np.zeros((1, 2)), NAMES, [None])
    with pytest.raises(RecognitionError, match=r"probe 1 \(nobody named\) and .* 0 \(bob\) is nan"):
        identify_by_similarity(np.where(SCORES == 0.3, np.nan, SCORES), NAMES, [None] * 3)
    with pytest.raises(RecognitionError, match="no image of the person"):
        identify_by_similarity(SCORES, NAMES, ["zoe", None, None])
