"""Albedo and shape together: better than either, on one scale where one is missing."""

import numpy as np
import pytest
from recognition_experiment.calibration import calibrated

from scan2albedo.recognition import fused


def build_scores(seed, count=2000, together=0.5):
    """Return albedo's and shape's similarities (2, N), of one person in every second pair."""
    random = np.random.default_rng(seed)
    genuine = np.arange(count) % 2 == 0
    noise = random.multivariate_normal([0, 0], [[1, together], [together, 1]], count).T
    return np.array([[0.7], [0.8]]) + np.array([[0.04], [0.02]]) * (noise + 2.0 * genuine), genuine


def error(scores, genuine):
    """Return the equal error rate of scores (N,)."""
    rates = [(np.mean(scores[genuine] < t), np.mean(scores[~genuine] >= t)) for t in np.sort(scores)[::20]]
    return min(max(pair) for pair in rates)


def test_both_are_better_than_either():
    calibration = calibrated(*build_scores(0)[0], build_scores(0)[1])
    (albedo, shape), genuine = build_scores(1)
    together = fused({"albedo": albedo[None], "shape": shape[None]}, calibration)[0]
    alone = min(error(albedo, genuine), error(shape, genuine))
    assert error(together, genuine) < alone - 0.01
    # Of two normals 2 apart, correlated by 0.5, Fisher's discriminant is 2 * 2 / sqrt(3) apart.
    assert error(together, genuine) == pytest.approx(0.124, abs=0.02)


def test_where_one_is_missing_the_other_keeps_its_scale():
    scores, genuine = build_scores(0)
    calibration = calibrated(*scores, genuine)
    nothing = np.full((1, 1), np.nan)
    albedo, shape = np.array([[0.74], [0.74]]), np.array([[np.nan], [0.82]])
    of_albedo, both = fused({"albedo": albedo, "shape": shape}, calibration)
    assert of_albedo == pytest.approx(both, abs=0.01)
    assert np.isnan(fused({"albedo": nothing, "shape": nothing}, calibration)).all()


def test_where_all_are_compared_by_one_kind_its_similarities_stay():
    scores, genuine = build_scores(0)
    calibration = calibrated(*scores, genuine)
    known = np.array([[0.78, 1.0], [0.8, 0.9]])
    gray = np.array([[0.7, np.nan], [0.6, np.nan]])
    assert fused({"shape": known}, calibration) is known
    assert fused({"albedo": gray, "shape": known}, calibration) is known
    assert fused({"albedo": known, "shape": gray}, calibration) is known


def test_a_probe_is_compared_by_what_the_whole_gallery_has():
    scores, genuine = build_scores(0)
    calibration = calibrated(*scores, genuine)
    albedo = np.array([[0.9, 0.6, np.nan], [0.9, 0.6, 0.7], [0.9, np.nan, 0.7]])
    shape = np.array([[0.7, 0.8, 0.75], [0.7, 0.8, 0.75], [np.nan, 0.8, 0.75]])
    found = fused({"albedo": albedo, "shape": shape}, calibration)
    assert found[0].argsort().tolist() == shape[0].argsort().tolist()
    first, second, _ = calibration.both
    np.testing.assert_allclose(found[1], (first * albedo[1] + second * shape[1]) / (first + second))
    assert np.isfinite(found[2]).all()


def test_too_few_pairs_are_no_calibration():
    with pytest.raises(ValueError, match="2 pairs of one person and 4 of two"):
        calibrated(np.arange(6.0), np.arange(6.0), [1, 1, 0, 0, 0, 0])
