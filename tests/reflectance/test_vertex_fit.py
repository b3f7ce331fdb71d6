"""What vertices reflect is found, with how sure it is; every extreme of captures and fits has its test."""

from dataclasses import replace

import numpy as np
import pytest
from bench.flash_captures import design
from bench.judging import relative_rmse
from helpers.reflectance_errors import diffuse_error
from numpy.testing import assert_allclose
from worlds.flash_captures import head_capture, of_pairs, samples_of

from scan2albedo.core import Budget
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import ReflectanceFitOptions, fit_reflectance, point_light_lobes, vertex_fit
from scan2albedo.reflectance.point_light_lobes import tilted_normals
from scan2albedo.reflectance.vertex_fit import PRIOR_MEAN, PRIOR_STD

SQUARES = ReflectanceFitOptions(loss="squares")
EXACT = replace(SQUARES, normal_sigma_degrees=0)


@pytest.fixture(scope="module")
def capture():
    return head_capture(1500)


@pytest.fixture(scope="module")
def noisy(capture):
    return samples_of(capture, noise=0.01)


@pytest.fixture(scope="module")
def fit(noisy):
    return sound(noisy)


def pictures(capture, which, **how):
    """Samples of some of the pictures."""
    return samples_of(of_pairs(capture, np.asarray(which)), noise=0.01, **how)


def sound(*arguments, **options):
    """Fit: numbers wherever known, none elsewhere, bounds kept, intervals around the estimate."""
    fit = fit_reflectance(*arguments, **options)
    known = fit.reflectance.known
    for values in (fit.parameters, fit.std, fit.low, fit.high, fit.identifiability):
        assert np.isfinite(values[known]).all()
        assert np.isnan(values[~known]).all()
    assert (fit.low[known] >= 0).all()
    assert (fit.low[known] <= fit.parameters[known]).all()
    assert (fit.parameters[known] <= fit.high[known]).all()
    assert (fit.identifiability[known] <= 1 + 1e-9).all()
    assert not np.isnan(fit.condition[known]).any()
    assert not fit.identified[~known].any()
    return fit


def test_one_per_cent_of_noise(fit, capture, noisy):
    assert fit.converged
    assert np.array_equal(fit_reflectance(noisy).parameters, fit.parameters)
    assert diffuse_error(fit, capture) < 0.03
    assert np.nanmedian(fit.misfit) == pytest.approx(1, abs=0.1)


def test_intervals_are_those_of_the_posterior_before_the_bounds(capture):
    matt = replace(capture, truth=replace(capture.truth, weights=np.zeros((1500, 3))))
    samples = pictures(matt, np.arange(0, 99, 9))
    fit = fit_reflectance(samples, options=EXACT)
    steepest = np.where(samples.valid.any(-1), np.pi * samples.lobes[..., 0], 0).max(0)
    mean, precision = fit.level * np.array(PRIOR_MEAN), (fit.level * np.array(PRIOR_STD)) ** -2.0
    for v in np.flatnonzero(fit.pair_count > 3)[::50]:
        rows, right = design(samples, v)
        rows, right = rows[:-6], right[:-6]
        normal = rows.T @ rows + np.diag(precision)
        center = np.linalg.solve(normal, rows.T @ right + precision * mean)
        std = np.sqrt(np.diag(np.linalg.inv(normal))) * max(fit.misfit[v], 1.0) / steepest[v]
        assert_allclose(fit.std[v], std, rtol=1e-6)
        low = np.clip(center - 1.96 * std, 0, fit.parameters[v])
        high = np.maximum(center + 1.96 * std, fit.parameters[v])
        assert_allclose([fit.low[v], fit.high[v]], [low, high], atol=1e-3 * std.max())


def test_without_noise_what_is_identified_is_exact(capture):
    fit = fit_reflectance(samples_of(capture, said_noise=1e-9))
    sure, truth = fit.identified, capture.parameters
    assert sure.mean() > 0.95
    assert relative_rmse(fit.parameters[sure], truth[sure]) < 1e-6
    assert diffuse_error(fit, capture) < 1e-9


def test_a_shadow_nobody_knows_of_hardly_matters(capture, fit):
    shadowed = samples_of(capture, noise=0.01, shadowed=0.03)
    clean = diffuse_error(fit, capture)
    assert diffuse_error(fit_reflectance(shadowed), capture) < 1.3 * clean
    assert diffuse_error(fit_reflectance(shadowed, options=SQUARES), capture) > 3 * clean


def test_charbonnier_stands_between(capture):
    samples = pictures(capture, np.arange(0, 99, 3), shadowed=0.03)
    errors = [
        diffuse_error(fit_reflectance(samples, options=ReflectanceFitOptions(loss=loss)), capture)
        for loss in ("cauchy", "charbonnier", "squares")
    ]
    assert errors == sorted(errors)


def test_pictures_twice_as_bright_give_twice_the_reflectance_and_stronger_flashes_the_less(noisy, fit):
    brighter = replace(noisy, observed_linear=2 * noisy.observed_linear, sigma=2 * noisy.sigma)
    twice = fit_reflectance(brighter)
    assert_allclose(twice.parameters, 2 * fit.parameters, rtol=1e-9, atol=1e-12)
    assert_allclose(twice.std, 2 * fit.std, rtol=1e-6)
    assert (twice.identified == fit.identified).all()
    stronger = fit_reflectance(replace(noisy, lobes=3 * noisy.lobes))
    assert_allclose(stronger.activation, fit.activation, rtol=1e-9)
    assert_allclose(3 * stronger.std, fit.std, rtol=1e-6)


def test_order_of_pictures_and_company_of_vertices_do_not_matter(noisy, monkeypatch):
    options = ReflectanceFitOptions(normal_sigma_degrees=1.0)
    rng = np.random.default_rng(0)
    order, few = rng.permutation(99), rng.choice(1500, 200, replace=False)
    samples = noisy.of_pairs(order)
    names = ("observed_linear", "sigma", "valid", "lobes", "slopes")
    part = replace(samples, **{name: getattr(samples, name)[:, few] for name in names})
    whole = fit_reflectance(noisy, options=options)
    level = whole.level / fit_reflectance(part, options=options).level
    for name in ("PRIOR_MEAN", "PRIOR_STD"):  # the prior's unit is the level of all vertices
        monkeypatch.setattr(vertex_fit, name, level * np.array(getattr(vertex_fit, name)))
    found = fit_reflectance(part, options=options)
    assert_allclose(found.parameters, whole.parameters[few], rtol=1e-6, atol=1e-9)


def test_the_trace_falls_and_a_budget_ends_it(capture):
    samples = pictures(capture, np.arange(0, 99, 5), shadowed=0.1)
    rows = []
    whole = fit_reflectance(samples, on_progress=rows.append)
    errors = [row.error for row in whole.trace]
    assert len(rows) == len(errors) == whole.iterations + 1 > 4
    assert (np.diff(errors) <= 1e-12).all()
    assert whole.residual == errors[-1]
    short = sound(samples, budget=Budget(evaluations=3))
    assert len(short.trace) == 2  # the first evaluation found how far normals are off
    assert not short.converged


def test_unseen_vertices_are_not_known_and_no_pictures_refused(noisy):
    valid = noisy.valid.copy()
    valid[:, :100] = False
    valid[:, 100:200, 2] = False
    fit = sound(replace(noisy, valid=valid))
    assert (fit.reflectance.known == (np.arange(1500) >= 200)).all()
    assert (fit.pair_count[:100] == 0).all()
    assert (fit.activation[:100] == 0).all()
    assert (fit.pair_count[100:200] > 0).all()
    with pytest.raises(ReflectanceError, match="there are no pictures"):
        fit_reflectance(noisy.of_pairs(np.arange(0)))


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_pictures(capture, count):
    fit = sound(pictures(capture, [49, 46, 52, 16, 82][:count]))
    known = fit.reflectance.known
    assert known.any()
    assert fit.pair_count.max() <= count
    assert diffuse_error(fit, capture) < {1: 0.8, 2: 0.5, 5: 0.2}[count]
    if count == 1:
        assert np.isinf(fit.condition[known]).all()
        assert np.isnan(fit.misfit).all()
        assert fit.identified[known, 3:].sum(1).max() <= 1
    inside = (fit.low <= capture.parameters) & (capture.parameters <= fit.high)
    assert inside[known].mean() > 0.9


def test_least_pairs_leaves_out_the_little_seen(noisy):
    fit = fit_reflectance(noisy, options=ReflectanceFitOptions(least_pairs=60))
    assert (fit.reflectance.known == (noisy.pair_count >= 60)).all()
    assert 0 < fit.reflectance.known.sum() < 1500


def test_all_flashes_at_their_cameras(capture):
    """n.h = n.l: the first lobe cannot be told from the albedo, and that is said."""
    same = np.flatnonzero(np.isclose(capture.cameras, capture.lights).all(1))
    fit = sound(pictures(capture, same))
    known = fit.reflectance.known
    assert np.isinf(fit.condition[known]).all()
    assert not fit.identified[:, 3].any()
    assert (fit.identifiability[known, 3] > 0.5).all()
    assert diffuse_error(fit, capture) < 0.15


def test_no_highlight_was_hit(noisy):
    """A lobe that no picture shows keeps the prior's weight and width, and never explodes."""
    lobes = noisy.lobes.copy()
    lobes[..., 3] = 0.0
    fit = sound(replace(noisy, lobes=lobes))
    assert_allclose(fit.identifiability[:, 5], 1)
    assert_allclose(fit.parameters[:, 5], fit.level * PRIOR_MEAN[5])
    assert (fit.activation[:, 2] == 0).all()
    assert np.isinf(fit.condition).all()


def test_activation_says_how_near_a_highlight_came(fit):
    for k, exponent in enumerate((1, 8, 64)):
        found = fit.activation[:, k] ** (1 / exponent)
        assert (found <= 1 + 1e-12).all()
        assert_allclose(found, fit.activation[:, 0], rtol=1e-9)
    hit = fit.activation[:, 2] > 0.5
    assert fit.identified[hit, 5].all()
    assert fit.std[hit, 5].mean() < 0.5 * fit.std[~hit, 5].mean()


def test_the_condition_number_is_that_of_the_columns_as_they_are(noisy):
    squares = fit_reflectance(noisy, options=EXACT)
    for v in (0, 700):
        white, gloss = noisy.lobes[:, v, :1, None] * np.eye(3), noisy.lobes[:, v, None, 1:]
        rows = np.concatenate([white, np.repeat(gloss, 3, 1)], 2)
        expected = np.linalg.cond(rows[noisy.valid[:, v]])
        assert squares.condition[v] == pytest.approx(expected, rel=1e-6)


def test_grazing_light_is_not_trusted_beyond_its_worth(capture):
    """Vertices lit at less than three degrees to their tangent: wide intervals, no absurd albedos."""
    beside = np.array([[900.0, 0, -300], [850, 200, -250], [-900, 0, -300], [-850, 200, -250]])
    grazing = replace(capture, cameras=capture.cameras[[0, 11, 77, 88]], lights=beside, light=np.arange(4))
    samples = samples_of(grazing, noise=0.01)
    fit = sound(replace(samples, valid=samples.valid & (np.pi * samples.lobes[..., :1] < 0.05)))
    known = fit.reflectance.known
    assert known.sum() > 20
    assert (fit.std[known, :3] > 0.05).mean() > 0.9
    assert (fit.parameters[known] < 20 * fit.level).all()


def test_black_channels_and_faces(noisy):
    dark = head_capture(1500, black=1.0)
    fit = sound(samples_of(dark, noise=0.01))
    black = dark.truth.diffuse_linear == 0
    assert (fit.parameters[:, :3] == 0).any(1).sum() > 300
    assert (fit.low[:, :3][black] == 0).mean() > 0.95
    assert fit.reflectance.diffuse_linear[black].mean() < 0.01
    assert diffuse_error(fit, dark) < 0.03
    # Where all is black.
    fit = sound(replace(noisy, observed_linear=np.zeros((99, 1500, 3))))
    assert fit.level == 1
    assert np.abs(fit.parameters).max() < 0.5
    assert np.median(fit.reflectance.diffuse_linear) < 1e-3


def test_unknown_noise_shows_in_the_misfit(capture, fit):
    boastful = fit_reflectance(samples_of(capture, noise=0.01, said_noise=0.0025))
    assert np.nanmedian(boastful.misfit) == pytest.approx(4, rel=0.2)
    assert np.median(boastful.std[:, 0]) == pytest.approx(np.median(fit.std[:, 0]), rel=0.2)


def test_impossible_albedos_are_never_identified(capture):
    """Vertices that the mesh says are lit at a grazing angle are in full light."""
    samples = pictures(capture, np.arange(0, 99, 4))
    lobes = samples.lobes.copy()
    lobes[:, :50, 0] *= 0.3
    wrong = replace(samples, lobes=lobes, slopes=None)
    free = fit_reflectance(wrong)
    fit = sound(wrong, options=ReflectanceFitOptions(most_albedo=1.0))
    assert not free.impossible.any()
    above = (fit.parameters[:, :3] > 1).any(1)
    assert above[:50].mean() > 0.5
    assert free.identified[above, :3].any()
    assert (fit.impossible == above).all()
    assert not fit.identified[above].any()
    assert (fit.low[above] == 0).all()
    assert np.array_equal(fit.identified[~above], free.identified[~above])


@pytest.mark.parametrize("angle", [0.0, 1.0, 3.0])
def test_normals_that_are_off_cost_neither_accuracy_nor_honesty(capture, fit, angle):
    tilted = fit_reflectance(samples_of(capture, noise=0.01, normals_off_deg=angle))
    assert diffuse_error(tilted, capture) < 1.2 * diffuse_error(fit, capture)
    sure, truth = tilted.identified, capture.parameters
    inside = (tilted.low <= truth) & (truth <= tilted.high)
    assert 0.93 < inside[sure].mean() < 0.98
    assert np.median(tilted.std[:, :3]) < 1.15 * np.median(fit.std[:, :3])
    found = np.degrees(np.arctan(np.linalg.norm(tilted.tilt, axis=1)))
    assert np.median(found) == pytest.approx(angle, abs=0.15)
    assert np.median(tilted.normal_sigma_degrees) == pytest.approx(angle / np.sqrt(2), abs=0.25)


def test_normals_said_to_be_right_are_not_tilted(capture):
    samples = samples_of(capture, noise=0.01, normals_off_deg=3.0)
    right = fit_reflectance(samples, options=ReflectanceFitOptions(normal_sigma_degrees=0))
    assert (right.tilt == 0).all()
    assert (right.normal_sigma_degrees == 0).all()
    without = fit_reflectance(replace(samples, slopes=None))
    assert np.array_equal(right.parameters, without.parameters)
    assert diffuse_error(right, capture) > 2 * diffuse_error(fit_reflectance(samples), capture)


def test_lobes_of_tilted_normals_are_those_of_the_normals(capture):
    rng = np.random.default_rng(3)
    tilt = 0.1 * rng.standard_normal((1500, 2))
    samples = samples_of(capture)
    turned = tilted_normals(capture.normals, tilt)
    expected = point_light_lobes(capture.vertices, turned, capture.cameras, capture.lights)
    both = (samples.lobes[..., 1] > 0) & (expected[..., 0] > 0)
    assert_allclose(samples.turned_lobes(tilt)[both], expected[both], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(
    "wrong",
    [
        {"loss": "tukey"},
        {"normal_sigma_degrees": "often"},
        {"normal_sigma_degrees": -1.0},
        {"most_albedo": 0.0},
        {"least_pairs": 0},
    ],
)
def test_options_outside_their_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ReflectanceFitOptions(**wrong)
