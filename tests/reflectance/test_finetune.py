"""Fine-tuning: the closed form against plain ridge regression, truth approached, harm refused."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.half_ball import HalfBall
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull

from scan2albedo.core import Budget
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.fields import surface_diffusion
from scan2albedo.reflectance import MorphableReflectanceModel, finetune, fit_image
from scan2albedo.reflectance.finetune import best_change, is_improvement, smoothed

finetune_module = sys.modules["scan2albedo.reflectance.finetune"]
BALL = HalfBall.of(500, np.random.default_rng(5).normal(size=(2, 3, 3)) * 6)
POINTS, SEEN = BALL.points, BALL.seen
FACES = ConvexHull(np.vstack([POINTS, [0, 0, -0.01]])).simplices
FACES = FACES[~(len(POINTS) == FACES).any(1)]


def spot(direction, width, depth):
    toward = np.asarray(direction) / np.linalg.norm(direction)
    return depth * np.exp((POINTS @ toward - 1) / width**2)


BEARD = 1 - spot([0, -0.6, 0.8], 0.3, 0.25) + spot([0.5, 0.3, 0.8], 0.2, 0.15)


def pictures(count, seed, pattern=1.0):
    faces = BALL.people(count, seed, pattern)
    return [BALL.picture(face, 1000 * seed + k) for k, face in enumerate(faces)]


def tuned_with(model, shots, held_out, **options):
    return finetune(model, shots, held_out, FACES, 100 * POINTS, **options)


@pytest.fixture(scope="module")
def model():
    """Learned from ten faces without the pattern."""
    return MorphableReflectanceModel.from_samples(BALL.people(20, 0), components=8)


@pytest.mark.slow
def test_images_of_others_bring_the_model_nearer_to_the_truth(model, lighting, monkeypatch):
    monkeypatch.setattr(finetune_module, "ROUNDS", 3)
    tuned = tuned_with(model, pictures(14, 1, BEARD), pictures(5, 2, BEARD), lighting=lighting)
    assert tuned.accepted_steps
    assert tuned.held_out_after < 0.92 * tuned.held_out_before
    assert [row.error for row in tuned.trace] == sorted((r.error for r in tuned.trace), reverse=True)
    assert next(iter(tuned.trace)).error == tuned.held_out_before
    unseen = list(zip(BALL.people(5, 3, BEARD), pictures(5, 3, BEARD), strict=True))

    def albedo_error(model):
        fits = [(face, fit_image(shot, model, lighting)) for face, shot in unseen]
        return np.mean([BALL.albedo_error(f.face.reflectance.diffuse_linear, face) for face, f in fits])

    assert albedo_error(tuned.model) < 0.95 * albedo_error(model)
    assert_array_equal(tuned.model.basis[..., 4:], model.basis[..., 4:])
    norms = np.sqrt(np.sum(tuned.model.diffuse.basis**2, axis=(1, 2)))
    assert_allclose(tuned.model.deviation, norms, rtol=1e-12)


@pytest.mark.slow
def test_a_change_that_harms_is_not_taken(model, lighting, monkeypatch):
    for name, value in {"ROUNDS": 2, "MEAN_CHANGE": 5.0, "SMOOTHING_MM": 0.0}.items():
        monkeypatch.setattr(finetune_module, name, value)
    wrong = pictures(4, 1, 0.4 + 1.2 * (np.arange(len(POINTS)) % 2))
    tuned = tuned_with(model, wrong, pictures(4, 2), lighting=lighting)
    assert tuned.accepted_steps == ()
    assert tuned.converged
    assert tuned.model is model
    assert tuned.held_out_after == tuned.held_out_before


def test_the_closed_form_is_ridge_regression_over_all_unknowns(model, lighting):
    shots = pictures(3, 1, BEARD)
    fits = [fit_image(shot, model, lighting) for shot in shots]
    change = best_change(model, shots, fits, mean_change=0.1, basis_change=0.3)
    response = BALL.response
    for vertex in np.flatnonzero(SEEN)[[3, 50]]:
        rows, off, noise = [], [], []
        for shot, fit in zip(shots, fits, strict=True):
            b = fit.face.coefficients
            albedo, total, share = np.split(model.at(b), [3, 4], axis=1)
            diffuse, lobes = response.diffuse @ fit.light, response.specular @ fit.light
            gloss = np.einsum("vk,vkj->vj", share, lobes)
            residual = shot.observed_linear - albedo * diffuse - total * gloss
            spread = 1.482602218505602 * np.median(np.abs(residual[SEEN]))
            by_channel = np.column_stack([np.diag(diffuse[vertex]), gloss[vertex]])
            rows.append(np.kron(by_channel, np.append(1.0, b)))
            off.append(residual[vertex])
            noise.append(spread * np.maximum(np.abs(residual[vertex]), spread))
        scale = 0.1 * np.array([model.diffuse.mean.mean()] * 3 + [model.mean[:, 3].mean()])
        prior = np.kron(scale, np.append(1.0, np.full(8, 0.3)))
        a, weight = np.concatenate(rows), 1 / np.ravel(noise)
        normal = a.T @ (weight[:, None] * a) + np.diag(prior**-2)
        expected = np.linalg.solve(normal, a.T @ (weight * np.ravel(off)))
        assert_allclose(change[:, vertex].T, expected.reshape(4, 9), rtol=1e-6, atol=1e-12)
    assert (change[:, ~SEEN] == 0).all()


def test_smoothing_keeps_what_is_even_and_what_stands_alone():
    count = len(POINTS)
    change = np.ones((9, count, 4))
    change[1:] = np.eye(count)[40, :, None]
    smooth = smoothed(change, surface_diffusion(POINTS, FACES, 0.3))
    assert_allclose(smooth[0], 1, rtol=1e-12)
    assert smooth[1:].max() < 0.5
    assert_allclose(smooth[4, :, 1], smooth[2, :, 3])
    rest = FACES[(FACES != 40).all(1)]
    assert (smoothed(change, surface_diffusion(POINTS, rest, 0.3))[1:, 40] == 1).all()
    assert not smoothed(0 * change, surface_diffusion(POINTS, FACES, 0.3)).any()


@pytest.mark.slow
def test_what_the_model_does_not_know_stays_zero(model, lighting, monkeypatch):
    monkeypatch.setattr(finetune_module, "ROUNDS", 1)
    known = POINTS[:, 1] < 0.6
    parts = {"mean": model.mean * known[:, None], "basis": model.basis * known[:, None]}
    partial = replace(model, known=known, **parts)
    tuned = tuned_with(partial, pictures(2, 1, BEARD), pictures(1, 2, BEARD), lighting=lighting)
    assert tuned.accepted_steps
    assert (tuned.model.diffuse.mean[~known] == 0).all()
    assert (tuned.model.basis[:, ~known, 3] == 0).all()


def test_a_gain_counts_that_images_share(monkeypatch):
    before = np.array([[0.2], [0.3], [0.4], [0.25]])
    assert is_improvement(before, 0.98 * before)
    assert not is_improvement(before, before)
    assert not is_improvement(before, 0.9995 * before)
    one_alone = before * [[0.8], [1.01], [1.0], [1.02]]
    assert one_alone.mean() < 0.999 * before.mean()
    assert not is_improvement(before, one_alone)
    assert is_improvement(before[:1], 0.9 * before[:1])
    assert not is_improvement(np.zeros((2, 1)), np.zeros((2, 1)))
    two_kinds = np.repeat(before, 2, axis=1)
    assert is_improvement(two_kinds, 0.9 * two_kinds)
    assert not is_improvement(two_kinds, two_kinds * [0.9, 1.01])
    monkeypatch.setattr(finetune_module, "SIGNIFICANCE_LEVEL", 0.5)
    assert is_improvement(before, one_alone)


@pytest.mark.parametrize("budget", [1e-6, Budget(evaluations=2)])
def test_a_budget_that_ends_keeps_what_was_accepted(model, lighting, budget):
    shots, held_out = pictures(4, 1, BEARD), pictures(2, 2, BEARD)
    tuned = tuned_with(model, shots, held_out, lighting=lighting, budget=budget)
    assert tuned.model is model
    assert not tuned.converged
    assert tuned.held_out_before == tuned.held_out_after
    assert len(tuned.trace) == 1


@pytest.mark.slow
def test_models_without_directions_have_their_mean_tuned(lighting, monkeypatch):
    monkeypatch.setattr(finetune_module, "ROUNDS", 1)
    monkeypatch.setattr(finetune_module, "SIGNIFICANCE_LEVEL", 0.5)
    alone = MorphableReflectanceModel.from_samples(BALL.people(1, 0))
    tuned = tuned_with(alone, pictures(6, 1, BEARD), pictures(3, 2, BEARD), lighting=lighting)
    assert tuned.held_out_after < tuned.held_out_before
    assert tuned.model.components == 0


@pytest.mark.parametrize(
    ("shots", "held_out", "faces", "vertices", "words"),
    [
        (1, 0, FACES, POINTS, "0 held out"),
        (0, 1, FACES, POINTS, "0 images"),
        (1, 1, [[0, 1, len(POINTS)]], POINTS, "refer to vertices"),
        (1, 1, FACES, POINTS.repeat(2, 0), "one topology"),
    ],
)
def test_what_cannot_be_tuned_with_is_refused(model, shots, held_out, faces, vertices, words):
    with pytest.raises(ReflectanceError, match=words):
        finetune(model, pictures(shots, 1), pictures(held_out, 1), faces, vertices)
