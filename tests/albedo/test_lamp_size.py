"""The angular radius of lamps, and the colour of bounced light, on path-traced pictures."""

import pytest
from benchmarks.mitsuba_set import load_scenes

from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo

SIZE = "albedo.lamp_size"


@pytest.fixture(scope="module")
def scenes():
    names = ["person-gloss-flash-60-soft", "person-gloss-flash-30", "face-wood-distant-30"]
    return {scene.name: scene for scene in load_scenes(names)}


def _solved(scene, **options):
    estimate = estimate_albedo(scene.image, seed=0, options=EstimateOptions(**options))
    return estimate, albedo_error(estimate.albedo_linear, scene.albedo_linear, scene.image.mask).mse_percent


@pytest.mark.slow
def test_a_large_lamp_gets_its_size(scenes):
    scene = scenes["person-gloss-flash-60-soft"]
    sized, error = _solved(scene)
    point, without = _solved(scene, skip=(SIZE,))
    assert sized.plan.ran(SIZE)
    assert [light.radius_deg for light in sized.lights] == [6.0]
    assert [light.radius_deg for light in point.lights] == [0.0]
    assert error < 0.9 * without


def test_a_small_lamp_stays_a_point_unless_asked_for(scenes):
    scene = scenes["person-gloss-flash-30"]
    estimate, _ = _solved(scene)
    assert not estimate.plan.ran(SIZE)
    forced, _ = _solved(scene, force=(SIZE,))
    assert forced.plan.ran(SIZE)
    assert all(light.radius_deg >= 6 for light in forced.lights)


def test_bounced_light_has_the_colour_of_wood(scenes):
    # 0.031 % where the guide from colour takes bounced light for white.
    assert _solved(scenes["face-wood-distant-30"])[1] < 0.02
