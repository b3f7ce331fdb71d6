"""Reflectance and light of one image: derivatives, truth found again, outliers, gaps, budgets, bad input."""

import dataclasses
import itertools

import numpy as np
import pytest
from worlds.environments import generated_environment

from scan2albedo.core import Budget, Meter
from scan2albedo.errors import ReflectanceError
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    ImageObservation,
    LightingModel,
    MorphableReflectanceModel,
    VertexReflectance,
    fit_image,
    shade_environment,
)
from scan2albedo.reflectance.image_fit import ImageTerms

DIRECTIONS = distant_directions(1200)
NORMALS = DIRECTIONS[DIRECTIONS[:, 2] > 0]
TOWARD = np.array([0, 0, 3.0]) - NORMALS
VIEW = TOWARD / np.linalg.norm(TOWARD, axis=1, keepdims=True)
SEEN = np.einsum("vi,vi->v", NORMALS, VIEW) > 0.1


def people(count, seed):
    """Smooth reflectances over a hemisphere, twelve ways to differ."""
    shapes = np.random.default_rng(7).normal(size=(8, 12, 81)) @ harmonics(NORMALS).T * 0.4
    rng, faces = np.random.default_rng(seed), []
    for _ in range(count):
        fields = np.einsum("r,frv->fv", rng.normal(size=12) / np.sqrt(np.arange(1, 13)), shapes)
        diffuse = np.array([0.55, 0.38, 0.30]) * np.exp(0.1 * fields[0, :, None] + 0.03 * fields[1:4].T)
        lobes = np.exp(0.1 * fields[5:8].T) * [0.2, 0.4, 0.4]
        total = 0.25 * np.exp(0.1 * fields[4])
        weights = total[:, None] * lobes / lobes.sum(1, keepdims=True)
        faces.append(VertexReflectance(diffuse, weights, np.ones(len(NORMALS), bool)))
    return faces


@pytest.fixture(scope="module")
def model():
    return MorphableReflectanceModel.from_samples(people(40, 0), components=20)


def picture(face, seed, exposure=1.0, noise=0.0):
    light = exposure * project_environment(generated_environment(seed))
    color = shade_environment(face, NORMALS, VIEW, light).radiance_linear
    color = color * (1 + noise * np.random.default_rng(seed).normal(size=color.shape))
    return ImageObservation(color, NORMALS, VIEW, SEEN), light


def albedo_error(found, truth):
    scale = np.nansum(found * truth) / np.nansum(found * found)
    return np.sqrt(np.nansum((scale * found - truth) ** 2) / np.nansum(truth**2))


def test_derivatives_agree_with_finite_differences(model):
    observation, _ = picture(people(1, 5)[0], 0)
    terms = ImageTerms(observation, model, LightingModel.default(), Meter("test", "objective"))
    p = 0.3 * np.random.default_rng(1).normal(size=20 + 80 + 3)
    jacobian = terms.jacobian(terms.predict(p))
    for direction in np.random.default_rng(2).normal(size=(3, len(p))):
        ahead, behind = (terms.predict(p + h * direction).color for h in (1e-5, -1e-5))
        np.testing.assert_allclose(jacobian @ direction, (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-7)


def test_the_prediction_is_the_shading_of_the_model(model):
    observation, _ = picture(people(1, 5)[0], 0)
    lighting = LightingModel.default()
    terms = ImageTerms(observation, model, lighting, Meter("test", "objective"))
    p = 0.2 * np.random.default_rng(3).normal(size=103)
    b, g, t = terms.split(p)
    light = lighting.light(g, scale_rgb=np.exp(t))
    face = model.reconstruct(b)
    assert face.clipped_share == 0
    expected = shade_environment(face.reflectance, NORMALS, VIEW, light).radiance_linear
    np.testing.assert_allclose(terms.predict(p).color, expected[terms.used], rtol=1e-10)


@pytest.mark.slow
def test_faces_not_seen_before_are_found_whatever_the_exposure(model):
    errors, of_mean = [], []
    for seed, face in enumerate(people(5, 99)):
        observation, _ = picture(face, 50 + seed, exposure=10.0 ** (seed - 2), noise=0.01)
        fit = fit_image(observation, model)
        assert fit.converged
        assert fit.relative_rmse < 0.04
        errors.append(albedo_error(fit.face.reflectance.diffuse_linear, face.diffuse_linear))
        of_mean.append(albedo_error(model.diffuse.mean, face.diffuse_linear))
    assert np.mean(errors) < 0.05
    assert np.mean(errors) < 0.5 * np.mean(of_mean)


def test_the_fit_tells_colours_of_what_it_used_and_its_descent(model):
    observation, _ = picture(people(1, 3)[0], 8)
    fit = fit_image(observation, model)
    np.testing.assert_array_equal(np.isfinite(fit.radiance_linear).all(1), SEEN)
    off = fit.radiance_linear[SEEN] - observation.observed_linear[SEEN]
    assert fit.relative_rmse == pytest.approx(
        np.linalg.norm(off) / np.linalg.norm(observation.observed_linear[SEEN])
    )
    errors = [row.error for row in fit.trace]
    assert all(after < before for before, after in itertools.pairwise(errors))
    assert errors[-1] == fit.objective
    again = fit_image(observation, model)
    np.testing.assert_array_equal(again.face.coefficients, fit.face.coefficients)


@pytest.mark.slow
def test_exposure_moves_the_scale_and_nothing_else(model):
    face = people(1, 4)[0]
    one, ten = (fit_image(picture(face, 9, exposure)[0], model) for exposure in (1.0, 10.0))
    np.testing.assert_allclose(ten.scale_rgb, 10 * one.scale_rgb, rtol=1e-6)
    np.testing.assert_allclose(ten.face.coefficients, one.face.coefficients, atol=1e-6)


@pytest.mark.slow
def test_specks_hardly_move_the_face(model, monkeypatch):
    face = people(1, 6)[0]
    observation, _ = picture(face, 20, noise=0.01)
    specks = np.random.default_rng(0).random(len(NORMALS)) < 0.05
    color = np.where(specks[:, None], 5 * observation.observed_linear.max(), observation.observed_linear)
    spoilt = dataclasses.replace(observation, observed_linear=color)
    robust = fit_image(spoilt, model)
    clean = fit_image(observation, model)
    monkeypatch.setattr("scan2albedo.reflectance.image_fit.SOFTNESS", 100.0)
    squares = fit_image(spoilt, model)
    error = [
        albedo_error(f.face.reflectance.diffuse_linear, face.diffuse_linear) for f in (clean, robust, squares)
    ]
    assert error[1] < 1.1 * error[0] + 0.003
    assert error[2] > 2 * error[0]


def test_a_budget_that_ends_gives_the_best_so_far(model):
    observation, _ = picture(people(1, 3)[0], 8)
    with pytest.warns(RuntimeWarning, match="without having converged"):
        short = fit_image(observation, model, budget=Budget(evaluations=4))
    assert not short.converged
    assert [row.evaluations for row in short.trace][-1] <= 4
    assert short.objective < next(iter(short.trace)).error
    with pytest.warns(RuntimeWarning, match="0 steps"):
        start = fit_image(observation, model, budget=Budget(evaluations=1))
    assert (start.face.coefficients == 0).all()
    assert np.isfinite(start.relative_rmse)


def test_a_black_channel_does_not_break_the_fit(model):
    observation, _ = picture(people(1, 3)[0], 8)
    color = observation.observed_linear.copy()
    color[:, 2] = 0
    fit = fit_image(dataclasses.replace(observation, observed_linear=color), model)
    assert fit.scale_rgb[2] < 0.05 * fit.scale_rgb[0]
    assert np.isfinite(fit.face.coefficients).all()
    assert np.isfinite(fit.light).all()


@pytest.mark.parametrize("components", [0, 1])
def test_models_of_few_samples_fit_light_alone(components):
    faces = people(2, 1)
    small = MorphableReflectanceModel.from_samples(faces[: components + 1])
    observation, _ = picture(faces[0], 11)
    fit = fit_image(observation, small)
    assert fit.face.coefficients.shape == (components,)
    assert fit.relative_rmse < 0.03


def test_faces_without_lobes_stay_without(model):
    dull = [dataclasses.replace(f, weights=np.zeros_like(f.weights)) for f in people(10, 2)]
    flat = MorphableReflectanceModel.from_samples(dull)
    observation, _ = picture(dull[3], 12)
    fit = fit_image(observation, flat)
    assert (fit.face.reflectance.weights == 0).all()
    assert albedo_error(fit.face.reflectance.diffuse_linear, dull[3].diffuse_linear) < 0.05


def test_what_is_no_image_of_the_face_is_refused(model):
    observation, _ = picture(people(1, 3)[0], 8)
    with pytest.raises(ReflectanceError, match="length 2"):
        dataclasses.replace(observation, normals=2 * NORMALS)
    with pytest.raises(ReflectanceError, match="topology"):
        fit_image(ImageObservation(np.ones((5, 3)), NORMALS[:5], VIEW[:5], np.ones(5, bool)), model)
    with pytest.raises(ValueError, match="normals is"):
        dataclasses.replace(observation, normals=NORMALS[:3])


@pytest.mark.slow
def test_numbers_that_are_not_seen_do_not_matter(model):
    observation, _ = picture(people(1, 3)[0], 8)
    color, normals = observation.observed_linear.copy(), NORMALS.copy()
    color[~SEEN], normals[~SEEN] = np.nan, 0.0
    fit = fit_image(ImageObservation(color, normals, VIEW, SEEN), model)
    np.testing.assert_array_equal(fit.face.coefficients, fit_image(observation, model).face.coefficients)
