"""How sure the light is: calibrated against the truth, larger where less is known, and told in JSON."""

import json
import math

import numpy as np
import pytest
from bench.judging import calibration
from helpers.lit_scenes import (
    angle_deg,
    direction,
    hemisphere_geometry,
    lamps_and_waves,
    lit_scene,
    percent_off,
    render,
    shaded_image,
    texture,
)

from scan2albedo.albedo import EstimateOptions, estimate_albedo
from scan2albedo.albedo.node_field import Scales
from scan2albedo.albedo.uncertainty import (
    Alternative,
    LightUncertainty,
    expected_error,
    light_uncertainty,
)
from scan2albedo.core import Budget
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.lights import PointLight
from scan2albedo.synthetic import face, light_at

LIGHT = (35, 15)
PLAIN, SKIN = (texture(kind, 96)[..., 0] for kind in ("plain", "skin"))
GREY = [0.55 + contrast * (SKIN - 0.55) for contrast in (0.25, 0.5, 1.0)]
"""A grey texture with a quarter, a half and all of the contrast of skin."""


@pytest.fixture(scope="module")
def contrasts():
    """Estimates of hemispheres of grey texture."""
    geometry = hemisphere_geometry(96)
    colors = [render(geometry, grey[..., None] * np.ones(3), [LIGHT], bits=None) for grey in GREY]
    return [estimate_albedo(GeometryImage(*geometry, texture_linear=color), 1) for color in colors]


@pytest.fixture(scope="module")
def noisy():
    """Estimates of a plain hemisphere under growing noise."""
    return [
        estimate_albedo(lit_scene(LIGHT, kind="plain", size=96, noise=noise).image, 1)
        for noise in (0.01, 0.03, 0.06)
    ]


def _direction_deg(estimate):
    return math.degrees(estimate.uncertainty.direction_rad[0])


@pytest.mark.parametrize(
    ("shape", "noise", "azimuth_deg", "largest_deg", "percent"),
    [
        ("hemisphere", 0.0, 20, 3.3, 0.1),
        ("hemisphere", 0.03, 60, 3.3, 0.15),
        # From the front, soft light explains bumps smaller than a cell nearly as well.
        ("bumps", 0.0, 20, 18, 0.03),
        ("bumps", 0.03, 20, 18, 0.15),
        ("bumps", 0.0, 60, 2, 0.14),
        ("bumps", 0.03, 60, 2, 0.3),
    ],
)
def test_the_true_direction_lies_within_five_deviations(shape, noise, azimuth_deg, largest_deg, percent):
    scene = lit_scene((azimuth_deg, 10), shape=shape, noise=noise)
    estimate = estimate_albedo(scene.image, 1)
    assert angle_deg(estimate.lights[0], scene.light_directions[0]) < 5 * _direction_deg(estimate)
    # A deviation of any size would do otherwise.
    assert _direction_deg(estimate) < largest_deg
    assert percent_off(estimate, scene) < percent


def test_the_true_direction_lies_within_five_deviations_under_noise_and_on_a_face(noisy):
    light = light_at(40, 10, intensity=2.0)
    on_face = estimate_albedo(face(0, size=96, lights=(light,)).image, 1)
    cases = [(on_face, light.direction, 0.5), *((estimate, direction(*LIGHT), 1.8) for estimate in noisy)]
    for estimate, toward, largest_deg in cases:
        assert angle_deg(estimate.lights[0], toward) < 5 * _direction_deg(estimate)
        assert _direction_deg(estimate) < largest_deg


@pytest.mark.parametrize("source", ["noisy", "contrasts"])
def test_deviations_grow_with_noise_and_with_texture(source, request):
    found = request.getfixturevalue(source)
    sure = [e.uncertainty for e in found]
    figures = np.array([(one.direction_rad[0], one.intensity[0], one.albedo) for one in sure])
    # Noise or contrast at least doubles from one to the next.
    assert np.all(figures[1:] > 1.4 * figures[:-1])
    assert np.all(figures[-1] < 20 * figures[0])


def test_albedo_deviation_is_an_image_of_the_surface(contrasts):
    estimate = contrasts[-1]
    deviation, mask = estimate.albedo_deviation, estimate.image.mask
    assert deviation.dtype == np.float32
    assert deviation.shape == mask.shape
    assert np.all(deviation[~mask] == 0)
    assert np.all(deviation >= 0)
    rms = math.sqrt(float(np.mean(deviation[mask] ** 2)))
    assert rms == pytest.approx(estimate.uncertainty.albedo, rel=0.15)
    # A turn of the light, a strength that is off: both change the light most, for its size, in the gloom.
    cosine = estimate.image.normal @ estimate.lights[0].direction
    # A cell of 1/96 of the chart spans 0.03 of cosine at most.
    gloom = mask & (cosine > 0.03) & (cosine < 0.2)
    assert deviation[gloom].mean() > 1.5 * deviation[mask & (cosine > 0.6)].mean()


def test_albedo_deviation_tells_how_far_the_albedo_is_off(contrasts):
    for estimate, true in zip(contrasts, GREY, strict=True):
        mask = estimate.image.mask
        off = float(np.std(np.log(estimate.albedo_linear[mask, 0] / true[mask])))
        assert 0.1 < off / estimate.uncertainty.albedo < 5


def test_the_expected_error_holds_for_most_texels(noisy, contrasts):
    """Two texels in three err by less than what is said, nineteen in twenty by less than twice as much."""
    for estimate, true in zip(noisy + contrasts, [PLAIN] * 3 + GREY, strict=True):
        measured = estimate.confidence > 0
        inside, within = calibration(estimate.albedo_linear[..., 0], true, estimate.expected_error, measured)
        assert inside > 0.66
        assert within > 0.95
    said = [float(np.median(e.expected_error[e.image.mask])) for e in noisy]
    assert said[0] < said[1] < said[2] < 0.15
    assert np.all(noisy[0].expected_error[~noisy[0].image.mask] == 0)


def test_expected_error_names_each_of_its_sources():
    """Noise, an unsure light and what is not skin raise it; without any it is the least."""
    mask, none = np.ones((8, 8), bool), np.zeros((8, 8))
    least = expected_error(none, None, mask)
    assert np.ptp(least) == 0
    assert 0 < least[0, 0] < 0.05
    for sources in ((none + 0.1, None, mask), (none, none + 0.1, mask), (none, None, mask, none)):
        assert np.all(expected_error(*sources) > 0.1)
    assert np.array_equal(expected_error(none, None, mask, none + 1), least)
    assert np.all(expected_error(none + 1, None, mask) == 1)
    assert np.all(expected_error(none, None, ~mask) == 0)


def test_figures_are_json_and_alternatives_make_it_ambiguous(contrasts):
    lamps = PointLight(math.radians(30), 0.1), PointLight(math.radians(-40), 0.1)
    alternative = Alternative(lamps, np.float64(0.0123456))
    sure, unsure = (
        LightUncertainty((0.01, 0.02), (0.1, 0.2), 0.003, others) for others in ((), (alternative,))
    )
    for found in (contrasts[0].uncertainty, unsure):
        figures = found.figures()
        assert json.loads(json.dumps(figures)) == figures
    assert figures["direction_deviation_deg"] == [0.573, 1.1459]
    assert figures["intensity_deviation"] == [0.1, 0.2]
    assert figures["albedo_deviation"] == 0.003
    assert figures["alternatives"] == [{"lights_deg": [[30.0, 5.73], [-40.0, 5.73]], "excess": 0.01235}]
    assert unsure.ambiguous
    assert not any(found.ambiguous for found in (sure, *(e.uncertainty for e in contrasts)))


def test_the_order_in_which_the_search_holds_the_lights_does_not_matter():
    scene = shaded_image(lit_scene((-50, 0, 0.6), (50, 0, 3.0)).image, brdf="lambert")
    model, problem = scene.model(2), scene.posterior(32)
    known = problem.started(Scales())
    x = lamps_and_waves(model, ((-50, 0), (50, 0)), (0.6, 3.0))
    weak_first, strong_first = (
        light_uncertainty(problem.start(model, y, known)) for y in (x, x[[3, 4, 5, 0, 1, 2]])
    )
    assert weak_first.direction_rad == pytest.approx(strong_first.direction_rad, rel=1e-3)
    assert weak_first.intensity == pytest.approx(strong_first.intensity, rel=1e-3)
    assert weak_first.direction_rad[1] > 1.5 * weak_first.direction_rad[0]


@pytest.mark.parametrize(
    "arguments",
    [
        {"brdf": "spherical-harmonics"},
        {"options": EstimateOptions(objective="albedo-deviation"), "budget": Budget(evaluations=100)},
    ],
)
def test_it_is_none_where_nothing_tells_it(arguments):
    estimate = estimate_albedo(lit_scene(LIGHT, size=32).image, 1, **arguments)
    assert estimate.uncertainty is None
    assert estimate.albedo_deviation is None
