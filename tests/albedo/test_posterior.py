"""The posterior of light and albedo: derivatives, descent, and evidence, on scenes of another renderer."""

import math
from dataclasses import replace

import numpy as np
import pytest

from scan2albedo.albedo.node_field import Scales
from scan2albedo.albedo.posterior import Point, descend, robust_weights
from scan2albedo.core import Budget

FAR = math.inf
ALL = ("near", "rough", "specular", "occlusion", "bounce", "environment")


@pytest.fixture(scope="module")
def posed(scenes):
    """Return a function: an image as a search holds it, and the posterior of 24 cells along its side."""

    def pose(image, budget=Budget()):
        scene = scenes.lit_image(image, budget=budget, force=("albedo.shadows",))
        return scene, scene.posterior(24)

    return pose


@pytest.fixture(scope="module")
def bumps(scenes):
    return scenes.scene("bumps", "skin", [(30, 10, 2.0, FAR)], size=64)


@pytest.fixture(scope="module")
def ball(scenes):
    return scenes.scene("hemisphere", "skin", [(30, 10, 2.0, FAR)], size=64)


def _model(scene, lights, *parts):
    model = scene.model(lights)
    for part in parts:
        model = replace(model, **{part: True})
    return model


def _x(model, scenes, angles=((30, 10), (-40, 20))):
    toward = np.array([scenes.direction(*angle) for angle in angles[: model.lights]]).reshape(-1, 3)
    x = model.from_lights(toward, np.array([2.0, 0.7])[: model.lights])
    if model.environment:
        x[-8:] = np.random.default_rng(1).uniform(-0.15, 0.15, 8)
    return x


def _start(problem, model, x):
    return problem.start(model, x, problem.started(Scales()))


def _off_deg(point, scenes):
    (lamp,) = point.solution().hypothesis.lights()
    return math.degrees(math.acos(min(1.0, float(lamp.direction @ scenes.direction(30, 10)))))


def _light_off(point, scenes):
    """Return the standard deviation of log light beside the true one; alone, the true one has 0.38."""
    cosine = np.maximum(point.problem.level.normal @ scenes.direction(30, 10), 0)
    return float(np.std(np.log(point.light / (1 + 2.0 * cosine))))


def _settled(point, rounds=30):
    """Return the point with the weights that belong to its own errors."""
    for _ in range(rounds):
        point = point.moved(np.zeros(len(point.x)))
    return point


@pytest.mark.parametrize(("lights", "parts"), [(0, ALL[3:]), (1, ()), (2, ALL)])
def test_gradient_is_the_slope_of_the_cost_with_the_albedo_following(bumps, scenes, lights, parts, posed):
    scene, problem = posed(bumps.image)
    model = _model(scene, lights, *parts)
    point = _settled(_start(problem, model, _x(model, scenes)))
    gradient = point.quadratic()[1] - point.prior.slope
    step = 1e-4
    slopes = []
    for k in range(len(point.x)):
        ahead, behind = (_settled(point.moved(s * step * np.eye(len(point.x))[k]), 3) for s in (1, -1))
        slopes.append((ahead.cost - ahead.prior.cost - behind.cost + behind.prior.cost) / (2 * step))
    # A lamp's cast shadows move with its direction alone, not with its distance.
    known = np.ones(len(slopes), bool)
    if model.near:
        known[model.position_of("near")] = False
    expected = np.array(slopes)[known]
    assert gradient[known] == pytest.approx(expected, rel=0.02, abs=0.02 * np.abs(expected).max())


def test_the_model_of_the_cost_is_convex_and_symmetric(bumps, scenes, posed):
    scene, problem = posed(bumps.image)
    model = _model(scene, 2, *ALL)
    matrix = _start(problem, model, _x(model, scenes)).quadratic()[0]
    assert matrix == pytest.approx(matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > 0


def test_the_scale_of_albedo_and_exposure_are_one(ball, scenes, posed):
    """A start has the scale that fits best; a picture four times as dark has the same cost."""
    dark = replace(ball.image, texture_linear=ball.image.texture_linear * np.float32(0.25))
    costs = []
    for image in (ball.image, dark):
        scene, problem = posed(image)
        model = _model(scene, 1)
        costs.append(_start(problem, model, _x(model, scenes)).cost)
    assert costs[1] == pytest.approx(costs[0], rel=1e-5)


@pytest.mark.parametrize("parts", [(), ALL])
def test_descent_lowers_the_cost_and_stays_in_bounds(ball, scenes, parts, posed):
    scene, problem = posed(ball.image)
    model = _model(scene, 1, *parts)
    start = _start(problem, model, _x(model, scenes, ((0, 0),)))
    found = descend(start, 30, problem.meter)
    lower, upper = model.bounds
    assert (found.x[:-2] >= lower).all()
    assert (found.x[:-2] <= upper).all()
    assert found.cost < start.cost - 10


@pytest.mark.parametrize("angle", [(20, 0), (45, 5), (40, 25), (30, -5)])
def test_descents_with_scales_that_follow_lead_to_the_lamp(ball, scenes, angle, posed):
    """They start 15 degrees away, as some direction of the search does."""
    scene, problem = posed(ball.image)
    model = _model(scene, 1)
    point = _start(problem, model, _x(model, scenes, (angle,)))
    for evaluations in (6, 4, 10):
        point = descend(point, evaluations, problem.meter).rescaled().rescaled()
    assert _off_deg(point, scenes) < 6
    assert _light_off(point, scenes) < 0.06


def test_soft_light_beside_it_takes_part_of_the_lamp_but_the_light_is_right(ball, scenes, posed):
    scene, problem = posed(ball.image)
    model = _model(scene, 1, *ALL)
    point = _start(problem, model, _x(model, scenes, ((20, 0),)))
    for evaluations in (6, 4, 10):
        point = descend(point, evaluations, problem.meter).rescaled().rescaled()
    assert _off_deg(point, scenes) < 10
    assert _light_off(point, scenes) < 0.06


def test_descent_takes_no_more_evaluations_than_it_may(ball, scenes, posed):
    scene, problem = posed(ball.image, budget=Budget(evaluations=6))
    model = _model(scene, 1)
    start = _start(problem, model, _x(model, scenes, ((0, 0),)))
    before = problem.meter.evaluations
    descend(start, 2, problem.meter)
    assert problem.meter.evaluations <= before + 2
    descend(start, 50, problem.meter)
    assert problem.meter.evaluations <= 6


def test_evidence_is_for_a_lamp_that_is_there_and_against_one_that_is_not(scenes, ball, posed):
    unlit = scenes.scene("hemisphere", "skin", [], size=64)
    for image, there in ((ball.image, True), (unlit.image, False)):
        scene, problem = posed(image)
        none, one = (_model(scene, n) for n in (0, 1))
        without, with_lamp = (
            descend(_start(problem, m, _x(m, scenes)), 30, problem.meter).log_evidence() for m in (none, one)
        )
        assert (with_lamp > without + 3) if there else (with_lamp < without - 1)


def test_scales_follow_the_grain_of_the_picture(scenes, posed):
    """Without any albedo to explain, deviations of albedo fall; with strong grain, they rise."""
    scales = []
    for kind in ("plain", "wood"):
        image = scenes.scene("hemisphere", kind, [(30, 10, 2.0, FAR)], size=64).image
        scene, problem = posed(image)
        model = _model(scene, 1)
        point = _start(problem, model, _x(model, scenes))
        for _ in range(3):
            point = point.rescaled()
        scales.append((point.known.scales.albedo, point.known.scales.grain))
    assert (np.array(scales[0]) < np.array(scales[1])).all()
    assert max(scales[0]) < 1


@pytest.mark.parametrize("kind", ["plain", "skin"])
def test_the_scale_of_light_falls_where_the_light_is_right_and_not_where_it_is_wrong(scenes, kind, posed):
    """Light that no part stands for is rare in an exact scene; a dark half in other light shows some."""
    image = scenes.scene("hemisphere", kind, [(30, 10, 2.0, FAR)], size=64).image
    toward, dark = image.normal @ scenes.direction(30, 10), image.normal @ scenes.direction(-60, -10)
    half = 1 / (1 + np.exp(8 * (toward - 0.3)))
    wrong = np.exp(0.5 * half * np.sin(6 * dark))[..., None]
    found = []
    for factor in (1.0, wrong):
        texture = (image.texture_linear * factor).astype(np.float32)
        scene, problem = posed(replace(image, texture_linear=texture))
        model = _model(scene, 1)
        point = _start(problem, model, _x(model, scenes))
        for evaluations in (6, 4):
            point = descend(point, evaluations, problem.meter).rescaled().rescaled()
        found.append(point.known.scales.light)
    assert found[0] < 0.8
    assert found[1] > 1.2 * found[0]


def test_the_light_is_less_sure_where_it_is_dark(ball, scenes, posed):
    scene, problem = posed(ball.image)
    model = _model(scene, 1)
    point = descend(_start(problem, model, _x(model, scenes)), 20, problem.meter)
    deviation = point.light_deviation()
    cosine = problem.level.normal @ scenes.direction(30, 10)
    assert np.isfinite(deviation).all()
    assert (deviation >= 0).all()
    assert deviation[cosine < 0].mean() > 1.2 * deviation[cosine > 0.6].mean()


def test_a_few_odd_cells_hardly_move_the_light(ball, scenes, posed):
    """Student's t: a bright sticker is not explained by the light."""
    texture = ball.image.texture_linear.copy()
    texture[30:33, 20:23] *= 0.2
    found = []
    for image in (ball.image, replace(ball.image, texture_linear=texture)):
        scene, problem = posed(image)
        model = _model(scene, 1)
        point = descend(_start(problem, model, _x(model, scenes)), 20, problem.meter)
        found.append(point.solution().hypothesis.rows[0])
    assert math.degrees(math.acos(min(1.0, float(found[0][:3] @ found[1][:3])))) < 3
    assert found[1][4] == pytest.approx(found[0][4], rel=0.1)


def test_points_with_a_factor_of_their_weights_are_the_same(ball, scenes, posed):
    """Starts are compared under one set of weights, whose factor is computed once."""
    scene, problem = posed(ball.image)
    model = _model(scene, 1)
    x = _start(problem, model, _x(model, scenes)).x
    known = problem.started(Scales())
    kept = Point(problem, model, x, known, fixed=True)
    assert kept.known is known
    fresh = Point(problem, model, x, known)
    assert np.array_equal(kept.light, fresh.light)
    assert kept.cost == pytest.approx(fresh.cost, rel=0.05)


def test_evidence_does_not_hang_on_how_often_the_cells_were_weighed(ball, scenes, posed):
    """Odds of 3 decide: the search's own sequence of steps leaves less than a fifth of that open."""
    scene, problem = posed(ball.image)
    model = _model(scene, 1, *ALL)
    point = descend(_start(problem, model, _x(model, scenes)), 8, problem.meter).rescaled().rescaled()
    point = descend(point, 6, problem.meter).rescaled()
    assert point.log_evidence() == pytest.approx(_settled(point).log_evidence(), abs=0.3)


def test_frequent_errors_count_less_by_cauchys_law():
    sizes, variance = np.array([0.0, 1.0, 3.0]), np.full(3, 0.01)
    rare = robust_weights(0.1 * sizes, variance, 2.0)
    np.testing.assert_allclose(rare, 5 / (4 + sizes**2) / 0.02)
    frequent = robust_weights(0.1 * sizes, variance, 2.0, np.array([True, True, False]))
    np.testing.assert_allclose(frequent[:2] / frequent[0], 1 / (1 + sizes[:2] ** 2))
    assert frequent[2] == rare[2]
