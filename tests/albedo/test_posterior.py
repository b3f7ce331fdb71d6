"""The posterior of light and albedo: derivatives, descent, and evidence, on scenes of another renderer."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lit_scenes import angle_deg, direction, lamps_and_waves, lit_scene, shaded_image

from scan2albedo.albedo.node_field import Scales
from scan2albedo.albedo.posterior import descend, robust_weights
from scan2albedo.core import Budget

ALL = ("near", "rough", "specular", "occlusion", "bounce", "environment")
LAMP = (30, 10)
TOWARD = direction(*LAMP)


@pytest.fixture(scope="module")
def bumps():
    return lit_scene(LAMP, shape="bumps").image


@pytest.fixture(scope="module")
def ball():
    return lit_scene(LAMP).image


def _start(image, lights=1, parts=(), angles=(LAMP, (-40, 20)), budget=Budget()):
    """Return where a descent begins: lamps, and parts of the light, in a posterior of 24 cells a side."""
    scene = shaded_image(image, budget=budget, force=("albedo.shadows",))
    model = replace(scene.model(lights), parts=frozenset(parts))
    x, problem = lamps_and_waves(model, angles, (2.0, 0.7)), scene.posterior(24)
    return problem.start(model, x, problem.started(Scales()))


def _descended(point, evaluations):
    return descend(point, evaluations, point.problem.meter)


def _followed(point, *evaluations):
    """Return where descents end after each of which the scales follow."""
    for count in evaluations:
        point = _descended(point, count).rescaled().rescaled()
    return point


def _lamp(point):
    (lamp,) = point.solution().hypothesis.lights()
    return lamp


def _settled(point, rounds=30):
    """Return the point with the weights that belong to its own errors."""
    for _ in range(rounds):
        point = point.moved(np.zeros(len(point.x)))
    return point


@pytest.mark.parametrize(("lights", "parts"), [(0, ALL[3:]), (1, ()), (2, ALL)])
def test_gradient_is_the_slope_of_the_cost_with_the_albedo_following(bumps, lights, parts):
    point = _settled(_start(bumps, lights, parts))
    matrix, slope = point.quadratic
    gradient = slope - point.prior.slope
    step = 1e-4
    slopes = []
    for way in step * np.eye(len(point.x)):
        ahead, behind = (_settled(point.moved(moved), 3) for moved in (way, -way))
        slopes.append((ahead.cost - ahead.prior.cost - behind.cost + behind.prior.cost) / (2 * step))
    if point.model.has("near"):
        # A lamp's cast shadows move with its direction alone, not with its distance.
        gradient, slopes = (np.delete(k, point.model.slices["near"]) for k in (gradient, slopes))
    assert gradient == pytest.approx(np.array(slopes), rel=0.02, abs=0.02 * np.abs(slopes).max())
    assert matrix == pytest.approx(matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > 0


@pytest.mark.parametrize("parts", [(), ALL])
def test_descent_lowers_the_cost_and_stays_in_bounds(ball, parts):
    start = _start(ball, parts=parts, angles=((0, 0),))
    found = _descended(start, 30)
    lower, upper = start.model.bounds
    assert (found.x[:-2] >= lower).all()
    assert (found.x[:-2] <= upper).all()
    assert found.cost < start.cost - 10


@pytest.mark.parametrize(
    ("angle", "parts", "most_deg"),
    # Soft light beside the lamp takes a part of it, but the light is right.
    [((20, 0), (), 6), ((40, 25), (), 6), ((20, 0), ALL, 10)],
)
def test_descents_with_scales_that_follow_lead_to_the_light(ball, angle, parts, most_deg):
    """They start 15 degrees away, as some direction of the search does."""
    point = _followed(_start(ball, 1, parts, (angle,)), 6, 4, 10)
    assert angle_deg(_lamp(point), TOWARD) < most_deg
    cosine = np.maximum(point.problem.level.normal @ TOWARD, 0)
    # The logarithm of the true light deviates by 0.38.
    assert np.std(np.log(point.light / (1 + 2.0 * cosine))) < 0.06


def test_descent_takes_no_more_evaluations_than_it_may(ball):
    start = _start(ball, angles=((0, 0),), budget=Budget(evaluations=6))
    meter = start.problem.meter
    before = meter.evaluations
    _descended(start, 2)
    assert meter.evaluations <= before + 2
    _descended(start, 50)
    assert meter.evaluations <= 6


def test_evidence_is_for_a_lamp_that_is_there_and_against_one_that_is_not(ball):
    gains = []
    for image in (ball, lit_scene().image):
        without, with_lamp = (_descended(_start(image, n), 30).log_evidence() for n in (0, 1))
        gains.append(with_lamp - without)
    assert gains[0] > 3
    assert gains[1] < -1


def test_scales_follow_the_grain_of_the_picture():
    """Without any albedo to explain, deviations of albedo fall; with strong grain, they rise."""
    scales = []
    for kind in ("plain", "wood"):
        point = _start(lit_scene(LAMP, kind=kind).image)
        for _ in range(3):
            point = point.rescaled()
        scales.append((point.known.scales.albedo, point.known.scales.grain))
    assert (np.array(scales[0]) < np.array(scales[1])).all()
    assert max(scales[0]) < 1


def test_the_scale_of_light_falls_where_the_light_is_right_and_not_where_it_is_wrong(ball):
    """Light that no part stands for is rare in an exact scene; a dark half in other light shows some."""
    half = 1 / (1 + np.exp(8 * (ball.normal @ TOWARD - 0.3)))
    wrong = np.exp(0.5 * half * np.sin(6 * (ball.normal @ direction(-60, -10))))[..., None]
    right_scale, wrong_scale = (
        _followed(_start(replace(ball, texture_linear=np.float32(texture))), 6, 4).known.scales.light
        for texture in (ball.texture_linear, ball.texture_linear * wrong)
    )
    assert right_scale < 0.8
    assert wrong_scale > 1.2 * right_scale


def test_a_few_odd_cells_hardly_move_the_light(ball):
    """Student's t: a bright sticker is not explained by the light."""
    texture = ball.texture_linear.copy()
    texture[30:33, 20:23] *= 0.2
    plain, marked = (
        _lamp(_descended(_start(image), 20)) for image in (ball, replace(ball, texture_linear=texture))
    )
    assert angle_deg(marked, plain.direction) < 3
    assert marked.intensity == pytest.approx(plain.intensity, rel=0.1)


def test_points_with_a_factor_of_their_weights_are_the_same(ball):
    """Starts are compared under one set of weights, whose factor is computed once."""
    start = _start(ball)
    known = start.problem.started(Scales())
    kept = start.problem.at(start.model, start.x, known, fixed=True)
    assert kept.known is known
    fresh = start.problem.at(start.model, start.x, known)
    assert np.array_equal(kept.light, fresh.light)
    assert kept.cost == pytest.approx(fresh.cost, rel=0.05)


def test_evidence_does_not_hang_on_how_often_the_cells_were_weighed(ball):
    """Odds of 3 decide: the search's own sequence of steps leaves less than a fifth of that open."""
    point = _descended(_followed(_start(ball, parts=ALL), 8), 6).rescaled()
    assert point.log_evidence() == pytest.approx(_settled(point).log_evidence(), abs=0.3)


def test_frequent_errors_count_less_by_cauchys_law():
    sizes, variance = np.array([0.0, 1.0, 3.0]), np.full(3, 0.01)
    rare = robust_weights(0.1 * sizes, variance, 2.0)
    np.testing.assert_allclose(rare, 5 / (4 + sizes**2) / 0.02)
    frequent = robust_weights(0.1 * sizes, variance, 2.0, np.array([True, True, False]))
    np.testing.assert_allclose(frequent[:2] / frequent[0], 1 / (1 + sizes[:2] ** 2))
    assert frequent[2] == rare[2]
