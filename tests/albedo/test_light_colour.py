"""Colours of the light on a ball: found where there are any, white where there are none."""

import math
from dataclasses import replace

import numpy as np
import pytest

from scan2albedo.albedo import EstimateOptions
from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.light_colour import light_colours
from scan2albedo.albedo.lit_image import LitImage
from scan2albedo.albedo.posterior import Posterior, descend
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.core import Meter

LAMP, INTENSITY = (50, 10), 2.0
WARM = np.array([1.4, 1.0, 0.6])


@pytest.fixture(scope="module")
def ball(scenes):
    return scenes.scene("hemisphere", "skin", [(*LAMP, INTENSITY, math.inf)], size=64, quantize=False)


@pytest.fixture(scope="module")
def lit(ball, scenes):
    """Return a function: the image, and where the posterior is largest, when the lamp has a colour."""

    def at(color, albedo=ball.albedo):
        cosine = np.maximum(ball.image.normal @ scenes.direction(*LAMP), 0)[..., None]
        texture = (0.3 * albedo * (1 + INTENSITY * cosine * color)).astype(np.float32)
        image = replace(ball.image, texture_linear=texture * ball.image.mask[..., None])
        prior, meter = AlbedoPrior.stationary(), Meter("albedo", "")
        usable = usable_texels(image)
        scene = LitImage(image, usable, "lambert", (0.0, 0.0, 1.0), EstimateOptions(), meter, prior)
        level, model = scene.level(40), scene.model(1)
        problem = Posterior(
            level,
            (level.center + 0.5) / np.asarray(image.shape),
            scene.lattice(level),
            scene.soft(level),
            prior,
            meter,
        )
        x = model.from_lights(scenes.direction(*LAMP)[None], np.array([INTENSITY]))
        return descend(problem.start(model, x), 10, meter)

    return at


def _light(point, colours):
    """Return (N, 3) the coloured light of lamps and ambient light on the cells."""
    soft = np.outer(point.light - point.lamps.sum(0), colours.ambient)
    cast = np.exp(point.problem.nodes @ colours.cast)
    return (soft + point.lamps.T @ colours.lamps) * cast


def test_white_light_stays_white(lit):
    point = lit(np.ones(3))
    found = light_colours(point, None)
    assert found.step.ran
    light = _light(point, found)
    ratios = np.log(light / light[:, :1])
    assert np.abs(ratios).max() < 0.05
    assert float(found.step.evidence.removeprefix("log odds ")) < 1


def test_a_warm_lamp_beside_white_ambient_light_is_found(lit):
    point = lit(WARM)
    found = light_colours(point, None)
    red, _, blue = found.lamps[0] / found.ambient
    assert red / blue > 1 + 0.5 * (WARM[0] / WARM[2] - 1)
    light = _light(point, found)
    cosine = point.lamps[0] / np.exp(point.x[2])
    true = 1 + INTENSITY * cosine[:, None] * WARM
    ours, truth = (np.log(part[:, 0] / part[:, 2]) for part in (light, true))
    assert np.std(ours - truth) < 0.4 * np.std(truth)


def test_the_mean_light_is_white(lit):
    point = lit(WARM)
    found = light_colours(point, None)
    mean = np.average(_light(point, found), axis=0, weights=point.problem.level.weight)
    assert mean == pytest.approx(np.full(3, mean[1]), rel=0.01)


def test_the_caller_leaves_it_white(lit):
    found = light_colours(lit(WARM), False)
    assert (found.step.ran, found.step.reason) == (False, "left out by the caller")
    for parts in (found.lamps, found.ambient, found.bounce):
        assert (parts == 1).all()
    for more in (found.harmonics, found.cast):
        assert not more.any()


def test_a_grey_picture_is_left_exactly_white(lit, ball):
    grey = np.repeat(ball.albedo.mean(-1, keepdims=True), 3, -1)
    found = light_colours(lit(np.ones(3), grey), None)
    assert not found.step.ran
    assert (found.lamps == 1).all()
    assert not found.cast.any()


def test_a_channel_without_light_stays_finite(lit, ball):
    point = lit(np.ones(3), ball.albedo * [1.0, 1.0, 0.0])
    found = light_colours(point, None)
    assert np.isfinite(_light(point, found)).all()
    assert (_light(point, found) > 0).all()
