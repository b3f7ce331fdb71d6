"""Several kinds together: better than any, on one scale where one is missing, light left aside."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import Calibration, albedo_templates, fused, same_person_log_odds
from scan2albedo.recognition.result_identification import CALIBRATION, log_odds_by_kind


def build_scores(seed, count=2000):
    """Return albedo's and shape's similarities (N,), and which pairs are of one person: every second."""
    random = np.random.default_rng(seed)
    genuine = np.arange(count) % 2 == 0
    noise = random.multivariate_normal([0, 0], [[1, 0.5], [0.5, 1]], count).T
    scores = np.array([[0.7], [0.8]]) + np.array([[0.04], [0.02]]) * (noise + 2.0 * genuine)
    return {"albedo": scores[0], "shape": scores[1]}, genuine


def fused_rows(scores, *calibration):
    """Return the log odds of scores (N,) by kind."""
    return fused({kind: np.array(values)[None] for kind, values in scores.items()}, *calibration)[0]


@pytest.fixture(scope="module")
def calibration():
    """The distributions that scores are drawn from."""
    spread = ((1.6e-3, 4e-4), (4e-4, 4e-4))
    return Calibration(("albedo", "shape"), (0.78, 0.84), (0.7, 0.8), spread)


def test_log_odds_are_those_of_the_pairs(calibration):
    scores, genuine = build_scores(2, 20000)
    odds = fused_rows(scores, calibration)
    for low, high in ((-3, -1), (-1, 1), (1, 3)):
        here = (odds > low) & (odds < high)
        expected = np.mean(1 / (1 + np.exp(-odds[here])))
        assert genuine[here].mean() == pytest.approx(expected, abs=0.03)


def test_both_are_better_than_one_which_keeps_its_scale_where_the_other_is_missing(calibration):
    scores, genuine = build_scores(1)
    gray = np.full(len(genuine), np.nan)
    # Of normals 2 apart Phi(1) are right; of two, correlated by 0.5, Fisher's are 4 / sqrt(3) apart.
    for given, right in ((scores, 0.876), (scores | {"albedo": gray}, 0.84)):
        odds = fused_rows(given, calibration)
        assert np.mean((odds > 0) == genuine) == pytest.approx(right, abs=0.015)
    assert np.isnan(fused_rows({"albedo": gray, "shape": gray}, calibration)).all()


def test_a_probe_is_compared_by_what_the_whole_gallery_has(calibration):
    albedo = np.array([[0.9, 0.6, np.nan], [0.9, 0.6, 0.7], [0.9, np.nan, 0.7]])
    shape = np.array([[0.7, 0.8, 0.75], [0.7, 0.8, 0.75], [np.nan, 0.8, 0.75]])
    found = fused({"albedo": albedo, "shape": shape}, calibration)
    assert_allclose(found[:1], fused({"shape": shape[:1]}, calibration))
    parts = log_odds_by_kind({"albedo": albedo[1:2], "shape": shape[1:2]}, calibration)
    assert_allclose(found[1:2], parts["albedo"] + parts["shape"])
    assert np.isfinite(found[2]).all()


def test_a_texture_that_is_alike_by_its_light_decides_nothing():
    # The right person under other light, and a stranger under the probe's: more alike as photographed.
    right, wrong = fused_rows({"albedo": [0.70, 0.62], "texture": [0.66, 0.70], "shading": [0.60, 0.80]})
    assert right > wrong
    right, wrong = fused_rows({"texture": [0.66, 0.70]})
    assert right < wrong


def test_in_one_light_the_shading_counts_for_nothing():
    spread = np.sqrt(CALIBRATION.shading_variance) * np.array([-0.9, 0.0, 0.9])
    cues = {"albedo": [0.7] * 3, "texture": [0.7] * 3, "shading": 0.7 + spread}
    assert_allclose(np.ptp(fused_rows(cues)), 0, atol=1e-9)
    assert np.ptp(fused_rows(cues | {"shading": 0.7 + 9 * spread})) > 1


def test_one_person_or_two_are_told_apart(albedo):
    first, again, other = (
        albedo(seed) + 0.05 * albedo(seed + noise) for seed, noise in ((0, 7), (0, 8), (1, 9))
    )
    a = {"albedo": albedo_templates([first], ["ann"])}
    b = {"albedo": albedo_templates([again, other], ["ann", "bob"])}
    odds = same_person_log_odds(a, b)
    assert odds.shape == (1, 2)
    assert odds[0, 0] > 0 > odds[0, 1]
    assert_allclose(same_person_log_odds(b, a), odds.T, atol=1e-3)
    with pytest.raises(RecognitionError, match="one set has templates of albedo, the other of nothing"):
        same_person_log_odds(a, {})


def test_the_calibration_in_use_is_one():
    covariance = np.array(CALIBRATION.covariance)
    assert np.linalg.eigvalsh(covariance).min() > 0
    slopes = np.linalg.solve(covariance, np.subtract(CALIBRATION.same, CALIBRATION.other))
    assert (slopes[:3] > 0).all()
    assert slopes[3] < 0


def test_pairs_of_no_one_gallery_know_no_level_of_the_shape():
    alike = {"shape": np.array([[0.9]])}
    within = log_odds_by_kind(alike, CALIBRATION)["shape"]
    across = log_odds_by_kind(alike, CALIBRATION, CALIBRATION.shape_variance)["shape"]
    share = CALIBRATION.covariance[2][2] / (CALIBRATION.covariance[2][2] + CALIBRATION.shape_variance)
    assert_allclose(across, share * within)
