"""Reflectance and light of one image: derivatives, truth found again, shadows, budgets, bad input."""

import itertools
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.half_ball import HalfBall
from numpy.testing import assert_allclose, assert_array_equal
from worlds.environments import generated_lighting

from scan2albedo.core import Budget, Meter
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import (
    ImageObservation,
    LightResponse,
    MorphableReflectanceModel,
    fit_image,
    shade_environment,
)
from scan2albedo.reflectance.image_fit import ImageTerms

image_fit = sys.modules["scan2albedo.reflectance.image_fit"]
BALL = HalfBall.of(700)
SEEN = BALL.seen
OPEN = BALL.response
FACE = BALL.people(1, 5)[0]
IMAGE = BALL.picture(FACE, 3)


@pytest.fixture(scope="module")
def model():
    return MorphableReflectanceModel.from_samples(BALL.people(24, 0), components=10)


@pytest.fixture(scope="module")
def lighting():
    return generated_lighting(count=200, components=30)


@pytest.fixture(scope="module")
def fit(model, lighting):
    return fit_image(IMAGE, model, lighting)


@pytest.fixture
def terms(model, lighting):
    return ImageTerms(IMAGE, model, lighting, Meter("test", "objective"))


def albedo_error(fit, face=FACE):
    return BALL.albedo_error(fit.face.reflectance.diffuse_linear, face)


MAY_STOP = pytest.mark.filterwarnings("ignore:the image fit stopped")


def descends(fit):
    errors = [row.error for row in fit.trace]
    return all(after < before for before, after in itertools.pairwise(errors)) and errors[-1] == fit.objective


def test_derivatives_agree_with_finite_differences(terms):
    p = 0.3 * np.random.default_rng(1).normal(size=len(terms.prior))
    jacobian = terms.jacobian(terms.predict(p))
    for direction in np.random.default_rng(2).normal(size=(3, len(p))):
        ahead, behind = (terms.predict(p + h * direction).color for h in (1e-5, -1e-5))
        assert_allclose(jacobian @ direction, (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-7)


def test_the_prediction_is_the_shading_of_the_model(terms, model, lighting):
    p = 0.2 * np.random.default_rng(3).normal(size=len(terms.prior))
    b, g, t = terms.split(p)
    face = model.reconstruct(b)
    assert face.clipped_share == 0
    light = lighting.light(g, scale_rgb=np.exp(t))
    expected = shade_environment(face.reflectance, BALL.normals, BALL.view, light).radiance_linear
    assert_allclose(terms.predict(p).color, expected[terms.used], rtol=1e-10)


def test_faces_not_seen_before_are_found_whatever_the_exposure(model):
    errors, of_mean = [], []
    for seed, face in enumerate(BALL.people(5, 99)):
        fit = fit_image(BALL.picture(face, 50 + seed, exposure=10.0 ** (seed - 2)), model)
        assert fit.converged
        assert fit.relative_rmse < 0.04
        errors.append(albedo_error(fit, face))
        of_mean.append(BALL.albedo_error(model.diffuse.mean, face))
    assert np.mean(errors) < 0.05
    assert np.mean(errors) < 0.5 * np.mean(of_mean)


def test_the_fit_tells_colours_of_what_it_used_and_its_descent(fit, model, lighting):
    assert_array_equal(np.isfinite(fit.radiance_linear).all(1), SEEN)
    observed = IMAGE.observed_linear[SEEN]
    off = np.linalg.norm(fit.radiance_linear[SEEN] - observed) / np.linalg.norm(observed)
    assert fit.relative_rmse == pytest.approx(off)
    assert descends(fit)
    again = fit_image(IMAGE, model, lighting)
    assert_array_equal(again.face.coefficients, fit.face.coefficients)


def test_exposure_moves_the_scale_and_nothing_else(fit, model, lighting):
    ten = fit_image(replace(IMAGE, observed_linear=10 * IMAGE.observed_linear), model, lighting)
    assert_allclose(ten.scale_rgb, 10 * fit.scale_rgb, rtol=1e-6)
    assert_allclose(ten.face.coefficients, fit.face.coefficients, atol=1e-6)


def test_specks_hardly_move_the_face(fit, model, lighting, monkeypatch):
    specks = np.random.default_rng(0).random(len(SEEN)) < 0.05
    color = np.where(specks[:, None], 5 * IMAGE.observed_linear.max(), IMAGE.observed_linear)
    spoilt = replace(IMAGE, observed_linear=color)
    robust = fit_image(spoilt, model, lighting)
    monkeypatch.setattr(image_fit, "SOFTNESS", 100.0)
    squares = fit_image(spoilt, model, lighting)
    assert albedo_error(robust) < 1.1 * albedo_error(fit) + 0.003
    assert albedo_error(squares) > 2 * albedo_error(fit)


def test_a_budget_that_ends_gives_the_best_so_far(model, lighting):
    with pytest.warns(RuntimeWarning, match="without having converged"):
        short = fit_image(IMAGE, model, lighting, budget=Budget(evaluations=4))
    assert not short.converged
    assert [row.evaluations for row in short.trace][-1] <= 4
    assert short.objective < next(iter(short.trace)).error


@MAY_STOP
def test_a_black_channel_does_not_break_the_fit(model, lighting):
    black = replace(IMAGE, observed_linear=IMAGE.observed_linear * [1, 1, 0])
    fit = fit_image(black, model, lighting)
    assert fit.scale_rgb[2] < 0.05 * fit.scale_rgb[0]


@MAY_STOP
@pytest.mark.parametrize("lights", [0, 30])
@pytest.mark.parametrize("samples", [1, 2])
def test_models_of_few_samples_fit_light_alone(samples, lights):
    faces = BALL.people(2, 1)
    small = MorphableReflectanceModel.from_samples(faces[:samples])
    lighting = generated_lighting(count=200, components=lights)
    fit = fit_image(BALL.picture(faces[0], 11, noise=0), small, lighting)
    assert fit.face.coefficients.shape == (samples - 1,)
    assert fit.light_coefficients.shape == (lights,)
    assert fit.relative_rmse < (0.03 if lights else 1)


def test_numbers_that_are_not_seen_do_not_matter(fit, model, lighting):
    color = np.where(SEEN[:, None], IMAGE.observed_linear, np.nan)
    other = ImageObservation(color, BALL.normals * SEEN[:, None], BALL.view, SEEN)
    other = fit_image(other, model, lighting)
    assert_array_equal(other.face.coefficients, fit.face.coefficients)


@MAY_STOP
def test_the_transfer_keeps_shadows_out_of_the_albedo(model, lighting):
    # A valley between two walls lets less light through from the sides, more or less by place.
    dark = 0.4 + 0.6 * np.abs(np.sin(3 * BALL.normals[:, :1]))
    squeeze = np.append(1.0, np.full(80, 1.3))
    folded = LightResponse(OPEN.diffuse * dark * squeeze, OPEN.specular * dark[..., None])
    with_it, without = [], []
    for seed, face in enumerate(BALL.people(3, 77)):
        image = BALL.picture(face, 70 + seed, transfer=folded)
        fit = fit_image(image, model, lighting)
        assert fit.converged
        with_it.append(albedo_error(fit, face))
        without.append(albedo_error(fit_image(replace(image, transfer=None), model, lighting), face))
    assert np.mean(with_it) < 0.05
    assert np.mean(with_it) < 0.6 * np.mean(without)


def distance_to(target, scale=1.0, offset=0.0):
    """Squared distance to colours (V, 3), whose gradient is NaN where the prediction is."""

    def distance(predicted, observed):
        off = predicted - target
        return offset + scale * np.nansum(off**2), 2 * scale * off

    return distance


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-3, 0.0), (1.0, 100.0), (1.0, -100.0)])
def test_a_perceptual_term_leads_to_its_known_optimum(terms, model, lighting, scale, offset, monkeypatch):
    """Colours that the models can make, of another face in other light than the image."""
    p = np.concatenate([0.5 * np.random.default_rng(4).normal(size=40), np.log([0.5, 0.6, 0.4])])
    target = np.full((len(SEEN), 3), np.nan)
    target[terms.used] = terms.predict(p).color
    monkeypatch.setattr(image_fit, "PRIOR_WEIGHT", dict.fromkeys((True, False), 0.0))
    monkeypatch.setattr(image_fit, "PHOTOMETRIC_WEIGHT", 1e-9)
    monkeypatch.setattr(image_fit, "_PERCEPTUAL_WEIGHT", 1 / scale)
    fit = fit_image(IMAGE, model, lighting, perceptual=distance_to(target, scale, offset))
    off = np.linalg.norm((fit.radiance_linear - target)[SEEN]) / np.linalg.norm(target[SEEN])
    assert off < 0.005
    assert fit.converged
    assert descends(fit)


def test_the_size_of_the_perceptual_term_counts(fit, model, lighting):
    brighter = 2 * IMAGE.observed_linear
    found = [
        fit_image(IMAGE, model, lighting, perceptual=distance_to(brighter, 10 * weight))
        for weight in (0.0, 1e-3, 10.0)
    ]
    sizes = [np.nanmean(one.radiance_linear) / np.nanmean(IMAGE.observed_linear[SEEN]) for one in found]
    assert sizes[0] == pytest.approx(1, abs=0.02)
    assert sizes[0] < sizes[1] < sizes[2]
    assert sizes[2] == pytest.approx(2, abs=0.05)
    assert_array_equal(found[0].face.coefficients, fit.face.coefficients)


@MAY_STOP
def test_a_gradient_that_is_wrong_never_raises_the_objective(model, lighting):
    def backwards(predicted, observed):
        off = predicted - observed
        return np.nansum(off**2), -2 * off

    assert descends(fit_image(IMAGE, model, lighting, perceptual=backwards))


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda p, o: (np.nan, np.zeros_like(p)), "the value nan"),
        (lambda p, o: (np.nansum(p), np.where(np.isnan(p), 0, np.nan)), "no gradient"),
        (lambda p, o: (np.nansum(p), np.zeros(3)), r"gradient is \(3,\)"),
        (lambda p, o: (np.sum(p), np.ones_like(p)), "leave out vertices that are NaN"),
        (lambda p, o: 1.0, "returned float"),
    ],
)
def test_what_a_perceptual_function_must_not_return(model, lighting, answer, words):
    with pytest.raises(ReflectanceError, match=words):
        fit_image(IMAGE, model, lighting, perceptual=answer)


FIRST = int(np.flatnonzero(SEEN)[0])
SPOILT = np.where(np.arange(len(SEEN))[:, None] == FIRST, np.nan, OPEN.diffuse)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"normals": 2 * BALL.normals}, ReflectanceError, "length 2"),
        ({"normals": BALL.normals[:3]}, ValueError, "normals is"),
        (
            {"transfer": LightResponse(SPOILT, OPEN.specular)},
            ReflectanceError,
            f"transfer of vertex {FIRST} ",
        ),
        (
            {"transfer": LightResponse(OPEN.diffuse[:5], OPEN.specular[:5])},
            ValueError,
            "diffuse of the trans",
        ),
        (
            {"transfer": LightResponse(0 * OPEN.diffuse, 0 * OPEN.specular)},
            ReflectanceError,
            "no light reach",
        ),
    ],
)
def test_what_is_no_image_of_the_face_is_refused(changes, error, words):
    with pytest.raises(error, match=words):
        replace(IMAGE, **changes)


def test_another_topology_is_refused(model):
    few = ImageObservation(np.ones((5, 3)), BALL.normals[:5], BALL.view[:5], np.ones(5, bool))
    with pytest.raises(ReflectanceError, match="topology"):
        fit_image(few, model)
