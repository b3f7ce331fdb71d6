"""The model against a plain SVD, with gaps, without lobes, of few samples, and on disk."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.npz import assert_comes_back, rewritten
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import MorphableReflectanceModel, VertexReflectance, reflectance_from_albedo
from scan2albedo.reflectance.morphable_model import reliability


def faces(count, vertices=60, rank=None, known=None):
    """Samples of a linear model with a rank; full rank when None."""
    rng, rank = np.random.default_rng(0), rank or count
    scores = rng.normal(size=(count, rank))
    basis = 0.02 * rng.normal(size=(rank, vertices, 7))
    basis[..., 4:] -= basis[..., 4:].mean(2, keepdims=True)
    values = np.repeat([0.4, 0.3, 1 / 3], [3, 1, 3]) + np.tensordot(scores, basis, 1)
    known = np.ones((count, vertices), bool) if known is None else known
    return [
        VertexReflectance(one[:, :3], one[:, 3:4] * one[:, 4:], k)
        for one, k in zip(values, known, strict=True)
    ]


learned = MorphableReflectanceModel.from_samples


def test_directions_are_those_of_a_singular_value_decomposition():
    samples = faces(7)
    model = learned(samples)
    x = np.stack([s.diffuse_linear.ravel() for s in samples])
    _, values, rows = np.linalg.svd(x - x.mean(0), full_matrices=False)
    assert model.components == 6
    assert_allclose(model.deviation, values[:6] / np.sqrt(6), rtol=1e-10)
    assert_allclose(model.diffuse.mean.ravel(), x.mean(0), rtol=1e-12)
    unit = model.diffuse.basis.reshape(6, -1) / model.deviation[:, None]
    assert_allclose(np.abs(np.einsum("ip,ip->i", unit, rows[:6])), 1, rtol=1e-10)
    assert_allclose(model.explained.sum(), 1, rtol=1e-12)


def albedo_off(model, sample):
    """Root mean square difference of the nearest albedo."""
    return np.sqrt(np.mean((model.project(sample).reflectance.diffuse_linear - sample.diffuse_linear) ** 2))


def test_samples_come_back_with_their_weights_and_coefficients_of_unit_variance():
    samples = faces(9)
    model = learned(samples)
    projected = [model.project(sample) for sample in samples]
    scores = np.stack([found.coefficients for found in projected])
    assert_allclose(np.cov(scores.T), np.eye(8), atol=1e-10)
    assert_allclose(scores.mean(0), 0, atol=1e-10)
    for sample, found in zip(samples, projected, strict=True):
        assert_allclose(found.reflectance.diffuse_linear, sample.diffuse_linear, atol=1e-12)
        assert_allclose(found.reflectance.weights, sample.weights, atol=1e-12)
        assert found.clipped_share == 0


def test_one_sample_or_its_copies_are_a_mean_and_two_have_one_direction():
    samples = faces(2)
    one = learned(samples[:1])
    assert one.components == 0
    assert_allclose(one.sample(3).reflectance.weights, samples[0].weights, rtol=1e-12)
    assert albedo_off(one, samples[1]) > 0
    two = learned(samples)
    assert two.components == 1
    assert max(albedo_off(two, s) for s in samples) < 1e-12
    same = learned(samples[:1] * 5)
    assert same.components == 0
    assert same.total_variance == pytest.approx(0, abs=1e-25)


def test_gaps_neither_move_the_mean_nor_pass_for_numbers():
    known = np.ones((6, 60), bool)
    known[:2, 10] = False  # known to four of six
    known[:4, 11] = False  # known to two of six
    samples = faces(6, known=known)
    model = learned(samples)
    assert np.flatnonzero(~model.known).tolist() == [11]
    assert model.support[[9, 10, 11]].tolist() == [6, 4, 2]
    mean = np.mean([s.diffuse_linear[10] for s in samples[2:]], axis=0)
    assert_allclose(model.diffuse.mean[10], mean, rtol=1e-12)
    lacking, made = (model.project(samples[k]).reflectance.diffuse_linear for k in (0, 4))
    assert np.isnan(made[11]).all()
    assert_allclose(made[10], samples[4].diffuse_linear[10], rtol=1e-9)
    assert_allclose(lacking[10], mean, rtol=1e-9)


def test_a_reflectance_with_gaps_is_projected_from_what_it_knows():
    samples = faces(10, rank=3)
    model = learned(samples)
    part, single = (replace(samples[3], known=np.arange(60) < count) for count in (20, 1))
    found = model.project(part).reflectance
    assert_allclose(found.diffuse_linear, samples[3].diffuse_linear, rtol=1e-6)
    assert np.abs(model.project(single, prior=1e-6).coefficients).max() < 10


def test_faces_without_lobes_and_black_channels_stay_so():
    rng = np.random.default_rng(4)
    diffuse = rng.uniform(0.2, 0.6, (5, 30, 3))
    diffuse[:, :, 2] = 0
    made = learned([reflectance_from_albedo(one) for one in diffuse]).sample(1)
    assert (made.reflectance.weights == 0).all()
    assert (made.reflectance.diffuse_linear[:, 2] == 0).all()
    assert made.clipped_share == 0
    assert learned([reflectance_from_albedo(np.zeros((30, 3)))] * 3).components == 0


def test_a_lobe_that_one_sample_lacks_is_a_gap_in_its_shares_only():
    samples = faces(4)
    weights = samples[0].weights.copy()
    weights[7] = 0
    samples[0] = replace(samples[0], weights=weights)
    model = learned(samples)
    share = np.mean([s.weights[7] / s.weights[7].sum() for s in samples[1:]], axis=0)
    assert_allclose(model.mean[7, 4:], share, rtol=1e-12)
    assert model.mean[7, 3] == pytest.approx(np.mean([s.weights[7].sum() for s in samples]))
    assert_allclose(model.project(samples[0]).reflectance.weights[7], 0, atol=1e-12)


def test_samples_are_reproducible_and_tell_what_was_clipped():
    model = learned(faces(6))
    assert_array_equal(model.sample(5).coefficients, model.sample(5).coefficients)
    assert model.sample(5).clipped_share == 0
    far = model.sample(5, scale=40.0)
    diffuse, total, share = np.split(model.at(far.coefficients) < -1e-9, [3, 4], axis=1)
    clipped = diffuse.sum(), (total | share).sum()
    assert min(clipped) > 0
    assert far.clipped_share == pytest.approx(sum(clipped) / (6 * len(diffuse)))
    assert (far.reflectance.diffuse_linear >= 0).all()
    assert (far.reflectance.weights >= 0).all()


def test_a_model_comes_back_from_its_file(tmp_path):
    known = np.random.default_rng(0).random((5, 60)) > 0.2
    assert_comes_back(learned(faces(5, known=known), components=3), tmp_path)
    with pytest.raises(ValueError, match="npz"):
        learned(faces(2)).save(tmp_path / "model.json")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": np.array('{"format": "something"}')}, "format"),
        ({"diffuse_mean": np.full((60, 3), np.nan)}, "NaN"),
        ({"sum_mean": np.zeros(59)}, "model.npz: all the input array dimensions"),
        ({"known": np.ones(60)}, "known holds float64"),
        ({"deviation": np.ones(7)}, "deviation is"),
    ],
)
def test_files_that_are_no_model_are_refused(tmp_path, changes, message):
    path = tmp_path / "model.npz"
    learned(faces(4)).save(path)
    rewritten(path, **changes)
    with pytest.raises(ReflectanceError, match=message):
        MorphableReflectanceModel.load(path)


@pytest.mark.parametrize(
    ("samples", "options", "error", "message"),
    [
        ([], {}, ReflectanceError, "no sample"),
        ([*faces(1), *faces(1, vertices=50)], {}, ReflectanceError, "sample 1 has 50"),
        (faces(3, known=np.zeros((3, 60), bool)), {}, ReflectanceError, "no vertex"),
        (faces(3), {"components": -1}, ValueError, "components"),
        (faces(3), {"least_support": 0}, ValueError, "least_support"),
        (faces(3), {"weights": np.full((3, 60), 2.0)}, ValueError, "weights must be"),
    ],
)
def test_what_cannot_be_learned_from_is_refused(samples, options, error, message):
    with pytest.raises(error, match=message):
        learned(samples, **options)


def test_what_does_not_fit_the_model_is_refused():
    model = learned(faces(3))
    with pytest.raises(ValueError, match=r"coefficients is \(1,\), expected \(2,\)"):
        model.reconstruct([0.0])
    for sample, prior, error, message in (
        (faces(1, vertices=50)[0], 0, ReflectanceError, "50 vertices"),
        (faces(1, known=np.zeros((1, 60), bool))[0], 0, ReflectanceError, "no vertex"),
        (faces(1)[0], -1, ValueError, "prior"),
    ):
        with pytest.raises(error, match=message):
            model.project(sample, prior=prior)


def test_vertices_with_little_weight_count_little():
    samples = faces(6)
    wild, weights = faces(6), np.ones((6, 60))
    wild[2].diffuse_linear[:10] = 5.0
    weights[2, :10] = 1e-4
    right = learned(samples[:2] + samples[3:])
    plain, trusting = (learned(wild, weights=given) for given in (None, weights))
    off = [np.abs(model.diffuse.mean - right.diffuse.mean)[:10].max() for model in (plain, trusting)]
    assert off[1] < 0.01 < 0.5 < off[0]
    assert plain.deviation[0] > 5 * trusting.deviation[0]


def test_reliability_falls_with_the_interval():
    sample = faces(1)[0]
    std = np.zeros((60, 6))
    std[0, 1] = 0.08
    std[1, :3] = 10.0
    weight = reliability(sample, std)
    assert weight[0] == pytest.approx(0.5, abs=0.05)  # as wide as people differ: a fifth of 0.4
    assert weight[1] < 1e-3
    assert (weight[2:] == 1).all()
    assert (reliability(sample, None) == 1).all()
