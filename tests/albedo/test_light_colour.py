"""Colours of the light on a ball: found where there are any, white where there are none."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.lit_scenes import lamps_and_waves, lit_scene, shaded_image

from scan2albedo.albedo.light_colour import light_colours
from scan2albedo.albedo.node_field import Scales
from scan2albedo.albedo.posterior import descend
from scan2albedo.albedo.prior import MEANS, AlbedoPrior
from scan2albedo.core.arrays import on_grid
from scan2albedo.synthetic import Material, light_at
from scan2albedo.synthetic.renderer import render

LAMP = (50, 10)
INTENSITY = 2.0
WARM = np.array([1.4, 1.0, 0.6])
TINT = np.array([1.05, 1.0, 0.91])
STATIONARY = AlbedoPrior.stationary()
GLOSS = Material(0.0, 0.15, 10.0)


@pytest.fixture(scope="module")
def ball():
    return lit_scene((*LAMP, INTENSITY), bits=None)


@pytest.fixture(scope="module")
def known(ball):
    """The prior that knows the colour of the ball."""
    skin = ball.albedo_linear[ball.image.mask]
    own = np.median(np.log(skin[:, 1:] / skin[:, :1]), axis=0)
    return replace(STATIONARY, chroma=np.vstack([own, 1e-4 * np.eye(2)]))


@pytest.fixture(scope="module")
def lit(ball):
    """Return a function: where the posterior is largest when the lamp has a colour, and all light a tint.

    With `gloss` there are highlights, and the point is that of the true light, highlights so strong.
    """

    def at(color=np.ones(3), albedo=ball.albedo_linear, prior=STATIONARY, tint=1.0, gloss=None):
        mask, material = ball.image.mask, Material(0.0) if gloss is None else GLOSS
        surface = ball.image.position[mask], ball.image.normal[mask], albedo[mask]
        shown = render(*surface, [light_at(*LAMP, intensity=INTENSITY)], material=material)
        by_lamp = (shown.radiance_linear - albedo[mask]) * color
        texture = np.float32(0.3 * tint * (albedo[mask] + by_lamp))
        image = replace(ball.image, texture_linear=on_grid(mask, texture))
        scene = shaded_image(image, brdf="lambert", prior=prior)
        model, problem = scene.model(1), scene.posterior(40)
        x, known = lamps_and_waves(model, (LAMP,), (INTENSITY,)), problem.started(Scales())
        if gloss is None:
            return descend(problem.start(model, x, known), 10, problem.meter)
        strength = gloss * 0.3 * GLOSS.specular_strength / problem.level.unit
        x = np.append(x, [strength, math.log(GLOSS.specular_exponent)])
        point = problem.start(replace(model, parts=model.parts | {"specular"}), x, known)
        return point.moved(np.zeros(len(point.x)))

    return at


def _light(point, colours):
    """Return (N, 3) the coloured light of lamps and ambient light on the cells, and its mean."""
    soft = np.outer(point.light - point.lamps.sum(0), colours.ambient)
    cast = np.exp(point.problem.nodes @ colours.cast)
    light = (soft + point.lamps.T @ colours.lamps) * cast
    return light, np.average(light, axis=0, weights=point.problem.level.weight)


def test_white_light_stays_white(lit):
    point = lit()
    found = light_colours(point, None)
    assert found.step.ran
    light, _ = _light(point, found)
    ratios = np.log(light / light[:, :1])
    assert np.abs(ratios).max() < 0.05
    assert float(found.step.evidence.removeprefix("log odds ")) < 1


def test_a_warm_lamp_beside_white_ambient_light_is_found(lit):
    point = lit(WARM)
    found = light_colours(point, None)
    red, _, blue = found.lamps[0] / found.ambient
    assert red / blue > 1 + 0.5 * (WARM[0] / WARM[2] - 1)
    light, mean = _light(point, found)
    assert mean == pytest.approx(np.full(3, mean[1]), rel=0.01)
    cosine = point.lamps[0] / np.exp(point.x[2])
    true = 1 + INTENSITY * cosine[:, None] * WARM
    ours, truth = (np.log(part[:, 0] / part[:, 2]) for part in (light, true))
    assert np.std(ours - truth) < 0.4 * np.std(truth)


def test_the_caller_leaves_it_white(lit):
    found = light_colours(lit(WARM), False)
    assert (found.step.ran, found.step.reason) == (False, "left out by the caller")
    assert (np.vstack([found.lamps, found.ambient, found.bounce]) == 1).all()
    assert not found.harmonics.any()
    assert not found.cast.any()


def test_a_grey_picture_is_left_exactly_white(lit, ball):
    grey = np.repeat(ball.albedo_linear.mean(-1, keepdims=True), 3, -1)
    found = light_colours(lit(albedo=grey), None)
    assert not found.step.ran
    assert (found.lamps == 1).all()
    assert not found.cast.any()


def test_a_channel_without_light_stays_finite(lit, ball):
    point = lit(albedo=ball.albedo_linear * [1.0, 1.0, 0.0])
    light, _ = _light(point, light_colours(point, None))
    assert np.isfinite(light).all()
    assert (light > 0).all()


def test_the_ratios_of_the_prior_belong_to_their_channels_whichever_leads(lit):
    rows = np.linspace(-0.3, 0.3, MEANS)[:, None]
    mean = np.dstack([0 * rows, rows, -rows]) * np.ones((MEANS, MEANS, 1))
    prior = replace(STATIONARY, mean=mean, spread=STATIONARY.spread / 10)
    pattern = np.exp(mean)
    red, blue = (lit(WARM, pattern * channels, prior) for channels in ([0.6, 0.3, 0.2], [0.1, 0.2, 0.6]))
    assert (red.problem.lead, blue.problem.lead) == (0, 2)
    for point in (red, blue):
        found = light_colours(point, None)
        assert np.log(found.lamps[0] / found.ambient)[[0, 2]] @ [1, -1] == pytest.approx(0.65, abs=0.25)
        assert np.abs(found.cast).max() < 0.12


def test_the_tint_of_all_light_is_told_by_what_is_known_of_the_albedo(lit, known):
    tints = []
    for prior in (known, STATIONARY):
        point = lit(prior=prior, tint=TINT)
        _, mean = _light(point, light_colours(point, None))
        tints.append(np.log(mean / mean[0]))
    assert tints[0] == pytest.approx(np.log(TINT / TINT[0]), abs=0.03)
    assert tints[1] == pytest.approx(np.zeros(3), abs=0.01)


@pytest.mark.parametrize("strength", [0.7, 1.4])
def test_the_channels_tell_how_strong_highlights_are(lit, strength):
    found = light_colours(lit(gloss=strength), None)
    assert abs(math.log(found.gloss * strength)) < 0.8 * abs(math.log(strength))


def test_highlights_are_weaker_where_skin_is_paler_than_the_picture(lit, known):
    strengths = []
    for slope in (0.0, 3.0):
        level = STATIONARY.level[0], slope, STATIONARY.level[2]
        point = lit(prior=replace(known, level=level), tint=TINT**3, gloss=1.4)
        strengths.append(light_colours(point, None).gloss)
    assert strengths[1] < 0.85 * strengths[0]
