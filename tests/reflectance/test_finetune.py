"""Fine-tuning: the closed form against plain ridge regression, truth approached, harm refused."""

import dataclasses
import sys

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from worlds.environments import generated_environment

from scan2albedo.core import Budget
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.operators import surface_diffusion
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    ImageObservation,
    MorphableReflectanceModel,
    VertexReflectance,
    finetune,
    fit_image,
    shade_environment,
)
from scan2albedo.reflectance.environment_shading import light_response
from scan2albedo.reflectance.finetune import best_change, is_improvement, smoothed

finetune_module = sys.modules["scan2albedo.reflectance.finetune"]
POINTS = distant_directions(500)
POINTS = POINTS[POINTS[:, 2] > 0]
WAVES = np.random.default_rng(5).normal(size=(2, 3, 3)) * 6
BUMPS = [np.sin(POINTS @ WAVES[0]).sum(1), np.sin(POINTS @ WAVES[1]).sum(1), np.zeros(len(POINTS))]
NORMALS = POINTS + 0.25 * np.stack(BUMPS, 1)
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
VIEW = np.array([0, 0, 3.0]) - POINTS
VIEW /= np.linalg.norm(VIEW, axis=1, keepdims=True)
SEEN = np.einsum("vi,vi->v", NORMALS, VIEW) > 0.1
FACES = ConvexHull(np.vstack([POINTS, [0, 0, -0.01]])).simplices
FACES = FACES[~(len(POINTS) == FACES).any(1)]


def spot(direction, width, depth):
    toward = np.asarray(direction) / np.linalg.norm(direction)
    return depth * np.exp((POINTS @ toward - 1) / width**2)


BEARD = 1 - spot([0, -0.6, 0.8], 0.3, 0.25) + spot([0.5, 0.3, 0.8], 0.2, 0.15)


def people(count, seed, pattern=1.0):
    """Smooth reflectances, eight ways to differ, times a pattern that all share."""
    shapes = np.random.default_rng(7).normal(size=(5, 8, 81)) @ harmonics(POINTS).T * 0.4
    rng, faces = np.random.default_rng(seed), []
    for _ in range(count):
        fields = np.einsum("r,frv->fv", rng.normal(size=8) / np.sqrt(np.arange(1, 9)), shapes)
        diffuse = np.array([0.55, 0.38, 0.30]) * np.exp(0.1 * fields[0, :, None] + 0.03 * fields[1:4].T)
        total = 0.25 * np.exp(0.1 * fields[4])
        weights = total[:, None] * np.array([0.2, 0.4, 0.4])
        diffuse = diffuse * np.broadcast_to(pattern, len(POINTS))[:, None]
        faces.append(VertexReflectance(diffuse, weights, np.ones(len(POINTS), bool)))
    return faces


def pictures(faces, seed):
    shots = []
    for k, face in enumerate(faces):
        light = project_environment(generated_environment(1000 * seed + k))
        color = shade_environment(face, NORMALS, VIEW, light).radiance_linear
        color = color * (1 + 0.01 * np.random.default_rng(k).normal(size=color.shape))
        shots.append(ImageObservation(color, NORMALS, VIEW, SEEN))
    return shots


@pytest.fixture(scope="module")
def model():
    """Learned from ten faces without the pattern."""
    return MorphableReflectanceModel.from_samples(people(20, 0), components=8)


def albedo_error(model, lighting, faces, shots):
    errors = []
    for face, shot in zip(faces, shots, strict=True):
        found = fit_image(shot, model, lighting).face.reflectance.diffuse_linear[SEEN]
        truth = face.diffuse_linear[SEEN]
        scale = np.sum(found * truth) / np.sum(found**2)
        errors.append(np.linalg.norm(scale * found - truth) / np.linalg.norm(truth))
    return np.mean(errors)


@pytest.mark.slow
def test_images_of_others_bring_the_model_nearer_to_the_truth(model, lighting, monkeypatch):
    monkeypatch.setattr(finetune_module, "ROUNDS", 3)
    shots = pictures(people(14, 1, BEARD), 1)
    held_out = pictures(people(5, 2, BEARD), 2)
    tuned = finetune(model, shots, held_out, FACES, 100 * POINTS, lighting=lighting)
    assert tuned.accepted_steps
    assert tuned.held_out_after < 0.92 * tuned.held_out_before
    assert [row.error for row in tuned.trace] == sorted((r.error for r in tuned.trace), reverse=True)
    assert next(iter(tuned.trace)).error == tuned.held_out_before
    faces = people(5, 3, BEARD)
    unseen = pictures(faces, 3)
    before, after = (albedo_error(m, lighting, faces, unseen) for m in (model, tuned.model))
    assert after < 0.95 * before
    np.testing.assert_array_equal(tuned.model.basis[..., 4:], model.basis[..., 4:])
    norms = np.sqrt(np.sum(tuned.model.diffuse.basis**2, axis=(1, 2)))
    np.testing.assert_allclose(tuned.model.deviation, norms, rtol=1e-12)


@pytest.mark.slow
def test_a_change_that_harms_is_not_taken(model, lighting, monkeypatch):
    for name, value in {"ROUNDS": 2, "MEAN_CHANGE": 5.0, "SMOOTHING_MM": 0.0}.items():
        monkeypatch.setattr(finetune_module, name, value)
    right = pictures(people(4, 2), 2)
    wrong = pictures(people(4, 1, 0.4 + 1.2 * (np.arange(len(POINTS)) % 2)), 1)
    tuned = finetune(model, wrong, right, FACES, 100 * POINTS, lighting=lighting)
    assert tuned.accepted_steps == ()
    assert tuned.converged
    assert tuned.model is model
    assert tuned.held_out_after == tuned.held_out_before


def test_the_closed_form_is_ridge_regression_over_all_unknowns(model, lighting):
    shots = pictures(people(3, 1, BEARD), 1)
    fits = [fit_image(shot, model, lighting) for shot in shots]
    m, n = 0.1, 0.3
    change = best_change(model, shots, fits, mean_change=m, basis_change=n)
    for vertex in np.flatnonzero(SEEN)[[3, 50]]:
        response = light_response(NORMALS[[vertex]], VIEW[[vertex]])
        rows, off, noise = [], [], []
        deviations = np.concatenate([[1.0], np.full(8, n)])
        for shot, fit in zip(shots, fits, strict=True):
            b = fit.face.coefficients
            prediction = np.full((len(POINTS), 3), np.nan)
            light = response.diffuse @ fit.light, response.specular @ fit.light
            used = light_response(NORMALS[SEEN], VIEW[SEEN])
            albedo = model.diffuse.mean + np.tensordot(b, model.diffuse.basis, 1)
            total = model.mean[:, 3] + np.tensordot(b, model.basis[..., 3], 1)
            share = model.mean[:, 4:] + np.tensordot(b, model.basis[..., 4:], 1)
            lobes = np.einsum("vk,vkj->vj", share[SEEN], used.specular @ fit.light)
            prediction[SEEN] = albedo[SEEN] * (used.diffuse @ fit.light) + total[SEEN, None] * lobes
            residual = shot.observed_linear - prediction
            spread = 1.4826 * np.median(np.abs(residual[SEEN]))
            x = np.concatenate([[1.0], b])
            for j in range(3):
                row = np.zeros((4, 9))
                row[j] = light[0][0, j] * x
                row[3] = (share[vertex] @ light[1][0])[j] * x
                rows.append(row.ravel())
                off.append(residual[vertex, j])
                noise.append(spread * max(abs(residual[vertex, j]), spread))
        scale = m * np.array([model.diffuse.mean.mean()] * 3 + [model.mean[:, 3].mean()])
        prior = np.outer(scale, deviations).ravel()
        a, weight = np.array(rows), 1 / np.array(noise)
        expected = np.linalg.solve(a.T @ (weight[:, None] * a) + np.diag(prior**-2), a.T @ (weight * off))
        expected = expected.reshape(4, 9)
        np.testing.assert_allclose(change[0, vertex], expected[:, 0], rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(change[1:, vertex].T, expected[:, 1:], rtol=1e-6, atol=1e-12)
    assert (change[:, ~SEEN] == 0).all()


def test_smoothing_keeps_what_is_even_and_what_stands_alone():
    count = len(POINTS)
    change = np.ones((9, count, 4))
    change[1:] = np.eye(count)[40, :, None]
    smooth = smoothed(change, surface_diffusion(POINTS, FACES, 0.3))
    np.testing.assert_allclose(smooth[0], 1, rtol=1e-12)
    assert smooth[1:].max() < 0.5
    np.testing.assert_allclose(smooth[4, :, 1], smooth[2, :, 3])
    rest = FACES[(FACES != 40).all(1)]
    assert (smoothed(change, surface_diffusion(POINTS, rest, 0.3))[1:, 40] == 1).all()
    assert not smoothed(0 * change, surface_diffusion(POINTS, FACES, 0.3)).any()


@pytest.mark.slow
def test_what_the_model_does_not_know_stays_zero(model, lighting, monkeypatch):
    monkeypatch.setattr(finetune_module, "ROUNDS", 1)
    known = POINTS[:, 1] < 0.6
    parts = {"mean": model.mean * known[:, None], "basis": model.basis * known[:, None]}
    partial = dataclasses.replace(model, known=known, **parts)
    tuned = finetune(
        partial,
        pictures(people(2, 1, BEARD), 1),
        pictures(people(1, 2, BEARD), 2),
        FACES,
        vertices=100 * POINTS,
        lighting=lighting,
    )
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("pattern", [BEARD, 1.0], ids=["off", "right"])
def test_images_that_no_step_saw_are_never_explained_worse(lighting, seed, pattern, monkeypatch):
    monkeypatch.setattr(finetune_module, "ROUNDS", 2)
    model = MorphableReflectanceModel.from_samples(people(20, 100 * seed), components=8)
    first = 10 * (seed + 1)
    shots = pictures(people(10, first + 1, pattern), first + 1)
    held_out = pictures(people(8, first + 2, pattern), first + 2)
    tuned = finetune(
        model,
        shots,
        held_out,
        FACES,
        vertices=100 * POINTS,
        lighting=lighting,
    )
    third = pictures(people(20, first + 3, pattern), first + 3)
    before, after = (
        np.mean([fit_image(shot, m, lighting).relative_rmse for shot in third]) for m in (model, tuned.model)
    )
    assert after <= before
    if pattern is BEARD:
        assert after < 0.97 * before


def test_seconds_that_end_at_once_leave_the_model_as_it_is(model, lighting):
    shots, held_out = pictures(people(4, 1, BEARD), 1), pictures(people(2, 2, BEARD), 2)
    tuned = finetune(model, shots, held_out, FACES, 100 * POINTS, lighting=lighting, budget=1e-6)
    assert tuned.model is model
    assert not tuned.converged
    assert tuned.held_out_before == tuned.held_out_after


def test_a_budget_that_ends_keeps_what_was_accepted(model, lighting):
    shots, held_out = pictures(people(4, 1, BEARD), 1), pictures(people(2, 2, BEARD), 2)
    tuned = finetune(
        model, shots, held_out, FACES, 100 * POINTS, lighting=lighting, budget=Budget(evaluations=2)
    )
    assert not tuned.converged
    assert tuned.model is model
    assert len(tuned.trace) == 1


@pytest.mark.slow
def test_models_without_directions_have_their_mean_tuned(lighting, monkeypatch):
    monkeypatch.setattr(finetune_module, "ROUNDS", 1)
    monkeypatch.setattr(finetune_module, "SIGNIFICANCE_LEVEL", 0.5)
    alone = MorphableReflectanceModel.from_samples(people(1, 0))
    shots, held_out = pictures(people(6, 1, BEARD), 1), pictures(people(3, 2, BEARD), 2)
    tuned = finetune(alone, shots, held_out, FACES, 100 * POINTS, lighting=lighting)
    assert tuned.held_out_after < tuned.held_out_before
    assert tuned.model.components == 0


def test_what_cannot_be_tuned_with_is_refused(model):
    shots = pictures(people(1, 1), 1)
    with pytest.raises(ReflectanceError, match="0 held out"):
        finetune(model, shots, [], FACES, POINTS)
    with pytest.raises(ReflectanceError, match="0 images"):
        finetune(model, [], shots, FACES, POINTS)
    with pytest.raises(ReflectanceError, match="refer to vertices"):
        finetune(model, shots, shots, [[0, 1, len(POINTS)]], POINTS)
    with pytest.raises(ReflectanceError, match="one topology"):
        finetune(model, shots, shots, FACES, vertices=POINTS.repeat(2, 0))
    with pytest.raises(ReflectanceError, match="vertices are NaN"):
        finetune(model, shots, shots, FACES, vertices=np.full_like(POINTS, np.nan))
