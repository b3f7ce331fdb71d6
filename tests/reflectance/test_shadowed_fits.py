"""Fits to pictures with ray-traced shadows, as the benchmark makes them, are better than the mean face."""

import numpy as np
import pytest
from bench_reflectance_model import (
    ShadowedCases,
    albedo_error,
    fit_face,
    fit_image,
    learned,
    people_of_the_model,
    person,
    surface,
)

pytestmark = pytest.mark.slow


def albedo_errors(cases, lighting, with_transfer):
    fits = [fit_image(cases.picture(k, with_transfer), learned(60, 40), lighting) for k in range(4)]
    pairs = zip(fits, cases.faces, strict=True)
    return np.mean([albedo_error(fit.face.reflectance.diffuse_linear, face) for fit, face in pairs])


def of_mean(cases):
    return np.mean([albedo_error(learned(60, 40).diffuse.mean, face) for face in cases.faces])


def test_faces_of_the_model_are_found_in_shadow(lighting):
    cases = ShadowedCases.of(people_of_the_model(30)[:4], 70_000)
    with_it = albedo_errors(cases, lighting, True)
    assert with_it < 0.03
    assert with_it < 0.6 * albedo_errors(cases, lighting, False)
    assert with_it < 0.4 * of_mean(cases)


def test_a_person_of_the_model_with_strong_highlights_is_believed_without_details(lighting):
    model, s = learned(60, 40), surface()
    cases = ShadowedCases.of(people_of_the_model(23)[:1], 62_003)
    picture, (truth,) = cases.picture(0, True), cases.faces
    found = fit_face(picture, model, s.vertices, s.faces, lighting)
    assert found.plan.ran("reflectance.image.person")
    assert found.details is None
    alone = fit_image(picture, model, lighting).face.reflectance.diffuse_linear
    assert albedo_error(found.reflectance.diffuse_linear, truth) < 1.01 * albedo_error(alone, truth)


def test_new_faces_are_found_better_than_by_the_mean(lighting):
    cases = ShadowedCases.of([person(400 + k) for k in range(4)], 71_000)
    with_it = albedo_errors(cases, lighting, True)
    assert with_it < of_mean(cases)
    assert with_it < albedo_errors(cases, lighting, False)
