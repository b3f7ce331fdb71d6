"""Terms of image fits beyond the photometric one, light with shadows, and extremes."""

import dataclasses
import itertools
import sys
import warnings

import numpy as np
import pytest
from worlds.environments import generated_environment, generated_lighting

from scan2albedo.core import Meter
from scan2albedo.errors import ReflectanceError
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    ImageObservation,
    LightResponse,
    MorphableReflectanceModel,
    VertexReflectance,
    fit_image,
)
from scan2albedo.reflectance.environment_shading import light_response
from scan2albedo.reflectance.finetune import best_change
from scan2albedo.reflectance.image_fit import ImageTerms

image_fit = sys.modules["scan2albedo.reflectance.image_fit"]
DIRECTIONS = distant_directions(700)
NORMALS = DIRECTIONS[DIRECTIONS[:, 2] > 0]
TOWARD = np.array([0, 0, 3.0]) - NORMALS
VIEW = TOWARD / np.linalg.norm(TOWARD, axis=1, keepdims=True)
SEEN = np.einsum("vi,vi->v", NORMALS, VIEW) > 0.1
FIRST = int(np.flatnonzero(SEEN)[0])
OPEN = light_response(NORMALS, VIEW)


def people(count, seed):
    """Smooth reflectances over a hemisphere, eight ways to differ."""
    shapes = np.random.default_rng(7).normal(size=(5, 8, 81)) @ harmonics(NORMALS).T * 0.4
    rng, faces = np.random.default_rng(seed), []
    for _ in range(count):
        fields = np.einsum("r,frv->fv", rng.normal(size=8) / np.sqrt(np.arange(1, 9)), shapes)
        diffuse = np.array([0.55, 0.38, 0.30]) * np.exp(0.1 * fields[0, :, None] + 0.03 * fields[1:4].T)
        weights = 0.25 * np.exp(0.1 * fields[4])[:, None] * [0.2, 0.4, 0.4]
        faces.append(VertexReflectance(diffuse, weights, np.ones(len(NORMALS), bool)))
    return faces


@pytest.fixture(scope="module")
def model():
    return MorphableReflectanceModel.from_samples(people(24, 0), components=10)


@pytest.fixture(scope="module")
def lighting():
    return generated_lighting(count=200, components=30)


def folded():
    """What a valley between two walls lets through: less from the sides, more or less by place."""
    dark = 0.4 + 0.6 * np.abs(np.sin(3 * NORMALS[:, :1]))
    squeeze = np.ones(81)
    squeeze[1:] = 1.3
    return LightResponse(OPEN.diffuse * dark * squeeze, OPEN.specular * dark[..., None])


def picture(face, seed, transfer=None, grey=False):
    image = generated_environment(seed)
    image = np.repeat(image.mean(-1, keepdims=True), 3, -1) if grey else image
    color = (transfer or OPEN).shade(face, project_environment(image)).radiance_linear
    color = color * (1 + 0.01 * np.random.default_rng(seed).normal(size=color.shape))
    return ImageObservation(color, NORMALS, VIEW, SEEN, transfer)


def albedo_error(fit, face):
    found, truth = fit.face.reflectance.diffuse_linear[SEEN], face.diffuse_linear[SEEN]
    scale = np.sum(found * truth) / np.sum(found**2)
    return np.linalg.norm(scale * found - truth) / np.linalg.norm(truth)


def distance_to(target, scale=1.0, offset=0.0):
    """Squared distance to colours (V, 3), whose gradient is NaN where the prediction is."""

    def distance(predicted, observed):
        off = predicted - target
        return offset + scale * np.nansum(off**2), 2 * scale * off

    return distance


def finite(fit):
    numbers = [
        fit.face.coefficients,
        fit.light,
        fit.scale_rgb,
        fit.light_coefficients,
        fit.radiance_linear[SEEN],
    ]
    numbers += [fit.face.reflectance.diffuse_linear, fit.face.reflectance.weights]
    return (
        all(np.isfinite(n).all() for n in numbers) and np.isfinite([fit.objective, fit.relative_rmse]).all()
    )


def quiet_fit(*arguments, **options):
    """Fit without the warning that it did not converge."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the image fit stopped", category=RuntimeWarning)
        return fit_image(*arguments, **options)


def test_a_transfer_without_shadows_changes_nothing(model, lighting, monkeypatch):
    monkeypatch.setattr(image_fit, "PRIOR_WEIGHT", dict.fromkeys((True, False), 1e-3))
    plain = picture(people(1, 5)[0], 3)
    given = dataclasses.replace(plain, transfer=OPEN)
    one, two = (fit_image(image, model, lighting) for image in (plain, given))
    np.testing.assert_array_equal(one.face.coefficients, two.face.coefficients)
    changes = [
        best_change(model, [image], [one], mean_change=0.1, basis_change=0.1) for image in (plain, given)
    ]
    np.testing.assert_array_equal(*changes)


def test_the_transfer_keeps_shadows_out_of_the_albedo(model, lighting):
    with_it, without = [], []
    for seed, face in enumerate(people(3, 77)):
        image = picture(face, 70 + seed, folded())
        with_it.append(albedo_error(fit_image(image, model, lighting), face))
        bare = dataclasses.replace(image, transfer=None)
        without.append(albedo_error(quiet_fit(bare, model, lighting), face))
    assert np.mean(with_it) < 0.05
    assert np.mean(with_it) < 0.6 * np.mean(without)


def test_what_cannot_be_a_transfer_is_refused(model):
    image = picture(people(1, 5)[0], 3)
    spoilt = LightResponse(
        np.where(np.arange(len(SEEN))[:, None] == FIRST, np.nan, OPEN.diffuse), OPEN.specular
    )
    with pytest.raises(ReflectanceError, match=f"transfer of vertex {FIRST} "):
        dataclasses.replace(image, transfer=spoilt)
    with pytest.raises(ValueError, match="diffuse of the transfer is"):
        dataclasses.replace(image, transfer=LightResponse(OPEN.diffuse[:5], OPEN.specular[:5]))


def test_all_vertices_in_the_dark(model):
    dark = LightResponse(0 * OPEN.diffuse, 0 * OPEN.specular)
    with pytest.raises(ReflectanceError, match="no light reach"):
        dataclasses.replace(picture(people(1, 5)[0], 3), transfer=dark)


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-3, 0.0), (1.0, 100.0), (1.0, -100.0)])
def test_a_perceptual_term_leads_to_its_known_optimum(model, lighting, scale, offset, monkeypatch):
    """Colours that the models can make, of another face in other light than the image."""
    image = picture(people(1, 5)[0], 3)
    terms = ImageTerms(image, model, lighting, Meter("test", "objective"))
    p = np.concatenate([0.5 * np.random.default_rng(4).normal(size=40), np.log([0.5, 0.6, 0.4])])
    target = np.full((len(SEEN), 3), np.nan)
    target[terms.used] = terms.predict(p).color
    monkeypatch.setattr(image_fit, "PRIOR_WEIGHT", dict.fromkeys((True, False), 0.0))
    monkeypatch.setattr(image_fit, "PHOTOMETRIC_WEIGHT", 1e-9)
    monkeypatch.setattr(image_fit, "_PERCEPTUAL_WEIGHT", 1 / scale)
    fit = fit_image(image, model, lighting, perceptual=distance_to(target, scale, offset))
    off = np.linalg.norm((fit.radiance_linear - target)[SEEN]) / np.linalg.norm(target[SEEN])
    assert off < 0.005
    assert fit.converged
    errors = [row.error for row in fit.trace]
    assert all(after < before for before, after in itertools.pairwise(errors))


def test_the_size_of_the_perceptual_term_counts(model, lighting):
    image = picture(people(1, 5)[0], 3)
    brighter = 2 * np.asarray(image.observed_linear)
    scale = [
        fit_image(image, model, lighting, perceptual=distance_to(brighter, 10 * weight))
        for weight in (0.0, 1e-3, 10.0)
    ]
    sizes = [np.nanmean(fit.radiance_linear) / np.nanmean(image.observed_linear[SEEN]) for fit in scale]
    assert sizes[0] == pytest.approx(1, abs=0.02)
    assert sizes[0] < sizes[1] < sizes[2]
    assert sizes[2] == pytest.approx(2, abs=0.05)
    np.testing.assert_array_equal(
        scale[0].face.coefficients, fit_image(image, model, lighting).face.coefficients
    )


def test_a_gradient_that_is_wrong_never_raises_the_objective(model, lighting):
    image = picture(people(1, 5)[0], 3)

    def backwards(predicted, observed):
        off = predicted - observed
        return np.nansum(off**2), -2 * off

    fit = quiet_fit(image, model, lighting, perceptual=backwards)
    errors = [row.error for row in fit.trace]
    assert all(after < before for before, after in itertools.pairwise(errors))
    assert finite(fit)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (lambda p, o: (np.nan, np.zeros_like(p)), "the value nan"),
        (lambda p, o: (np.nansum(p), np.where(np.isnan(p), 0, np.nan)), "no gradient"),
        (lambda p, o: (np.nansum(p), np.zeros(3)), r"gradient is \(3,\)"),
        (lambda p, o: (np.sum(p), np.ones_like(p)), "leave out vertices that are NaN"),
        (lambda p, o: 1.0, "returned float"),
    ],
    ids=["NaN value", "NaN gradient", "wrong shape", "NaN from unused vertices", "no gradient"],
)
def test_what_a_perceptual_function_must_not_return(model, lighting, answer, told):
    with pytest.raises(ReflectanceError, match=told):
        fit_image(picture(people(1, 5)[0], 3), model, lighting, perceptual=answer)


def test_one_vertex(model, lighting):
    image = picture(people(1, 5)[0], 3)
    one = np.arange(len(SEEN)) == np.flatnonzero(SEEN)[5]
    fit = quiet_fit(dataclasses.replace(image, seen=one), model, lighting)
    assert np.isfinite(fit.face.coefficients).all()
    assert np.isfinite(fit.light).all()
    np.testing.assert_allclose(fit.radiance_linear[one], np.asarray(image.observed_linear)[one], rtol=0.02)


def test_some_colours_negative(model, lighting):
    """As of pictures whose dark was subtracted."""
    image = picture(people(1, 5)[0], 3)
    color = np.asarray(image.observed_linear).copy()
    color[::7] = -0.05 * color.mean()
    fit = quiet_fit(dataclasses.replace(image, observed_linear=color), model, lighting)
    assert finite(fit)
    assert albedo_error(fit, people(1, 5)[0]) < 0.1


def test_light_without_directions(model):
    alone = generated_lighting(count=20, components=0)
    assert alone.components == 0
    fit = quiet_fit(picture(people(1, 5)[0], 3), model, alone)
    assert fit.light_coefficients.shape == (0,)
    assert finite(fit)


def test_neither_model_has_directions():
    mean = MorphableReflectanceModel.from_samples(people(1, 0))
    fit = quiet_fit(picture(people(1, 5)[0], 3), mean, generated_lighting(count=20, components=0))
    assert fit.face.coefficients.shape == (0,)
    assert finite(fit)


def test_a_wrong_gamma_makes_errors_larger_but_finite(model, lighting):
    face = people(1, 5)[0]
    image = picture(face, 3)
    errors = []
    for gamma in (1.0, 1.5, 2.5):
        color = np.asarray(image.observed_linear) ** gamma
        fit = quiet_fit(dataclasses.replace(image, observed_linear=color), model, lighting)
        assert finite(fit)
        errors.append(albedo_error(fit, face))
    assert errors[0] < errors[1] < errors[2] < 1
