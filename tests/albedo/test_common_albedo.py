"""One albedo from several images of a face, each in its own light."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bench.judging import calibration

from scan2albedo import synthetic
from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo, estimate_common_albedo
from scan2albedo.core import Budget
from scan2albedo.errors import LightingError

COARSE = EstimateOptions(sizes=(12, 16, 20), maximal_lights=1)
TINT = np.array([0.8, 1.0, 1.25], np.float32)


@cache
def two_lights():
    lamps = synthetic.light_at(50, 10, intensity=2.0), synthetic.light_at(-40, 25, intensity=1.5)
    first, second = (synthetic.face(4, lights=(lamp,), size=96, noise=0.003) for lamp in lamps)
    other_camera = replace(second.image, texture_linear=second.image.texture_linear * TINT)
    return first, replace(second, image=other_camera)


@cache
def found():
    return estimate_common_albedo([scene.image for scene in two_lights()], options=COARSE)


def error(albedo, scene):
    return albedo_error(albedo.max(-1), scene.albedo_linear.max(-1), scene.image.seen).relative_rmse


@pytest.mark.slow
def test_two_lights_tell_more_than_the_better_of_them():
    scenes = two_lights()
    errors = [error(estimate_albedo(s.image, options=COARSE).albedo_linear, s) for s in scenes]
    assert error(found().albedo_linear, scenes[0]) < min(errors), errors


@pytest.mark.slow
def test_colours_of_cameras_are_brought_to_one_and_the_stated_error_holds():
    scene, common = two_lights()[0], found()
    ratio = common.gains[0] / common.gains[1]
    np.testing.assert_allclose(ratio / ratio[1], TINT, rtol=0.1)
    seen = scene.image.seen
    inside, _ = calibration(
        common.albedo_linear.max(-1), scene.albedo_linear.max(-1), common.expected_error, seen
    )
    assert inside > 0.6
    assert (common.coverage[seen] == 2).mean() > 0.9


def test_one_image_is_its_own_albedo_and_a_budget_ends_the_search():
    image = two_lights()[0].image
    common = estimate_common_albedo([image], options=COARSE, budget=Budget(evaluations=20))
    assert not common.converged
    np.testing.assert_allclose(common.albedo_linear, common.estimates[0].albedo_linear, rtol=1e-5)
    assert not common.disagreement.any()
    assert np.median(found().expected_error[image.seen]) < np.median(common.expected_error[image.seen])


@pytest.mark.slow
def test_what_one_image_shows_otherwise_is_told():
    first, second = two_lights()
    painted = second.image.texture_linear.copy()
    painted[40:50, 40:50] *= 0.4
    common = estimate_common_albedo(
        [first.image, replace(second.image, texture_linear=painted)], options=COARSE
    )
    spot = np.zeros(first.image.shape, bool)
    spot[42:48, 42:48] = True
    assert np.median(common.disagreement[spot]) > 3 * np.median(common.disagreement[first.image.mask & ~spot])


def test_images_that_cannot_be_joined_are_refused():
    with pytest.raises(LightingError, match="no image was given"):
        estimate_common_albedo([])
    small = synthetic.face(4, size=64).image
    with pytest.raises(LightingError, match="different charts"):
        estimate_common_albedo([two_lights()[0].image, small], options=COARSE, budget=Budget(evaluations=10))
    with pytest.raises(ValueError, match="common albedo"):
        estimate_common_albedo([small], brdf="spherical-harmonics")


@pytest.mark.slow
def test_photographs_of_a_person_say_more_together(shared_data):
    from bench.common_albedo import error as error_of, photographs

    person = dict(np.load(shared_data / "yale" / "yaleB12.npz"))
    made = photographs(person, np.array([0, 6, 3, 4]))
    value = estimate_common_albedo(made.images).albedo_linear.max(-1).astype(float)
    together = [error_of(value[on], made.truth[on]) for on in made.lit]
    # Alone they err by 1.5 % on average, by the true lamps by .8 %.
    assert np.mean(together) < 0.8
