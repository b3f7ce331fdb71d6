"""CMC and ROC curves against counting, SciPy's intervals and the rank statistic."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import binomtest, mannwhitneyu

from scan2albedo.recognition import cmc_curve, identify_by_similarity, roc_curve
from scan2albedo.recognition.curves import _rates_of_draw
from scan2albedo.runs.recognition import curve_figure


def build_identification(seed=0, persons=20, each=2, separation=1.5, decimals=9):
    """Normal similarities, higher by `separation` for the right person; rounded to make ties."""
    names = [f"p{k:03d}" for k in range(persons)]
    probes = names * each
    scores = np.random.default_rng(seed).standard_normal((len(probes), persons))
    scores += separation * (np.array(probes)[:, None] == np.array(names))
    return identify_by_similarity(scores.round(decimals), names, probes)


def area_under(own, others):
    """The chance that a similarity of `own` is above one of `others`, by ranks."""
    return mannwhitneyu(own, others).statistic / (len(own) * len(others))


NEVER_FIRST = identify_by_similarity([[0.1, 0.9]] * 3, ["ann", "bob"], ["ann"] * 3)


@pytest.mark.parametrize("found", [build_identification(), NEVER_FIRST])
def test_cmc_counts_ranks_with_the_intervals_of_scipy(found):
    curve = cmc_curve(found, confidence=0.9)
    assert curve.rank.tolist() == list(range(1, len(found.persons) + 1))
    hits = [int(sum(found.ranks <= k)) for k in curve.rank]
    assert_allclose(curve.rate, np.divide(hits, curve.probes))
    expected = [binomtest(hit, len(found.ranks)).proportion_ci(0.9, "exact") for hit in hits]
    assert_allclose(np.stack([curve.low, curve.high], 1), expected, atol=1e-9)


@pytest.mark.parametrize("decimals", [9, 0])
def test_roc_is_what_thresholds_accept(decimals):
    found = build_identification(decimals=decimals)
    own, others = found.similarities[found.genuine], found.similarities[~found.genuine]
    curve = roc_curve(found, false_accept_rates=[0.0, 0.01, 0.1, 0.5, 1.0], resamples=0)
    for bound, rate in zip(curve.false_accept_rate, curve.true_accept_rate, strict=True):
        thresholds = [*np.unique(found.similarities), np.inf]
        lowest = min(t for t in thresholds if (others >= t).mean() <= bound + 1e-12)
        assert rate == pytest.approx((own >= lowest).mean())
    assert curve.area == pytest.approx(area_under(own, others))
    assert curve.area_interval == (curve.area, curve.area)
    assert (curve.genuine, curve.impostors) == (40, 760)


def test_the_equal_error_rate_of_two_normals():
    found = build_identification(persons=300, each=1, separation=2.0)
    # The threshold half-way errs with the tail beyond one standard deviation on both sides.
    assert roc_curve(found, resamples=0).equal_error_rate == pytest.approx(0.1587, abs=0.03)


def test_a_resample_counts_claims_as_if_they_were_repeated():
    found = build_identification(persons=4, each=2)
    times = np.array([2, 0, 1, 3])
    own, others = [], []
    for i, prober in enumerate(np.searchsorted(found.persons, found.probe_names)):
        for j, claimed in enumerate(times):
            if prober == j:
                own += [found.similarities[i, j]] * times[prober]
            else:
                others += [found.similarities[i, j]] * (times[prober] * claimed)
    area = _rates_of_draw(found)(times.astype(float), np.array([0.1]))[0]
    assert area == pytest.approx(area_under(own, others))


def test_intervals_hold_the_truth_and_shrink_with_persons():
    # Of two normals 1.5 apart the area is the normal distribution at 1.5 / sqrt(2).
    sets = [build_identification(seed, persons, 1) for persons in (20, 80) for seed in range(30)]
    curves = [roc_curve(found, resamples=100, false_accept_rates=[0.1]) for found in sets]
    low, high = np.array([curve.area_interval for curve in curves]).T
    assert ((low < 0.8556) & (high > 0.8556)).sum() >= 50  # of 60, at 95 %
    few, many = np.split(high - low, 2)
    assert many.mean() == pytest.approx(few.mean() / 2, rel=0.15)


def test_few_claims_that_never_err_have_wide_intervals():
    found = identify_by_similarity(np.eye(3), ["ann", "bob", "cy"], ["ann", "bob", "cy"])
    curve = roc_curve(found, resamples=20)
    exact = binomtest(3, 3).proportion_ci(0.95, "exact")
    assert_allclose(curve.low, exact.low)
    assert curve.equal_error_rate == 0
    assert curve.equal_error_interval == (0, pytest.approx(1 - exact.low))
    assert curve.supported.sum() == (curve.false_accept_rate >= 1 / 6).sum()


def test_one_seed_gives_one_result():
    found = build_identification()
    first, again, other = (roc_curve(found, resamples=20, seed=seed) for seed in (3, 3, 4))
    assert_array_equal(first.low, again.low)
    assert first.area_interval == again.area_interval != other.area_interval


def test_choices_out_of_range_are_refused():
    found = build_identification()
    with pytest.raises(ValueError, match="confidence"):
        cmc_curve(found, confidence=1.0)
    with pytest.raises(ValueError, match="ascending"):
        roc_curve(found, false_accept_rates=[0.5, 0.1])


def test_figures_show_the_curve_with_its_interval():
    found = build_identification(persons=30)
    cmc, roc = cmc_curve(found), roc_curve(found, resamples=20)
    # Twenty ranks at most.
    for curve, x, y, shown, scale, told in (
        (cmc, cmc.rank, cmc.rate, slice(20), "linear", "60 probes: rank 1"),
        (roc, roc.false_accept_rate, roc.true_accept_rate, roc.supported, "log", "60 genuine claims: equal"),
    ):
        axis = curve_figure("texture", curve).axes[0]
        assert axis.get_xscale() == scale
        assert_array_equal(axis.lines[0].get_xydata(), np.stack([x, y], 1)[shown])
        bars = np.stack(axis.collections[0].get_segments())
        assert_array_equal(bars[..., 1], np.stack([curve.low, curve.high], 1)[shown])
        assert axis.figure.legends[0].get_texts()[0].get_text().startswith(f"texture, {told}")
