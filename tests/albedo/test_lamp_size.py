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
def test_the_size_of_a_lamp_hardly_matters_where_outlines_may_lie_beside(scenes):
    scene = scenes["person-gloss-flash-60-soft"]
    sized, error = _solved(scene)
    point, without = _solved(scene, skip=(SIZE,))
    assert all(light.radius_deg <= 12 for light in sized.lights)
    assert all(light.radius_deg == 0 for light in point.lights)
    assert error < 1.2 * without


@pytest.mark.slow
def test_bounced_light_has_the_colour_of_wood(scenes):
    assert _solved(scenes["face-wood-distant-30"])[1] < 0.06
