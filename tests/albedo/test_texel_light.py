"""The light found, on every texel and in its colours: without members the paper's, with them their mean."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.lit_scenes import shaded_image

from scan2albedo.albedo.light_colour import LightColours, light_colours
from scan2albedo.albedo.light_parameters import Solution
from scan2albedo.albedo.node_field import Scales
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.albedo.result import shade_image
from scan2albedo.albedo.shaded_image import Explanation, LightFound
from scan2albedo.albedo.shadows import OUTLINE_BLURS
from scan2albedo.albedo.texel_light import _Expected, _seen_shadows, _soft_light, _surface, light_on_texels
from scan2albedo.synthetic import face, light_at

WEAK = light_at(-50, 10, intensity=1.0)
STRONG = light_at(40, 15, intensity=3.0)
SOFT = ("occlusion", "bounce", "environment")


@pytest.fixture(scope="module")
def truth():
    return face(0, texture="plain", size=64, lights=[WEAK, STRONG], bits=None)


@pytest.fixture(scope="module")
def lit_face(truth):
    return shaded_image(truth.image, prior=AlbedoPrior.faces(), force=("albedo.shadows",))


def _solution(scene, lamps=(WEAK, STRONG), tail=(), parts=()):
    """Return lamps, the weaker one first, and soft light of parameters `tail`."""
    model = replace(scene.model(len(lamps)), parts=frozenset(parts))
    toward = np.array([lamp.direction for lamp in lamps])
    x = model.from_lights(toward, np.array([lamp.intensity for lamp in lamps]))
    x[3 * len(lamps) :] = tail
    return Solution(model, x, 0.1)


def _found(scene, solution, shift=0.0, spread=0.0, **colours):
    """Return a solution as the best explanation, in white light but for what `colours` replaces."""
    level, problem = scene.at(40).level, scene.posterior(40, OUTLINE_BLURS[0])
    point = problem.start(solution.model, solution.x, problem.started(Scales()))
    cells = np.ones(len(level.value))
    shown = replace(light_colours(point, False), **colours)
    return LightFound(
        solution, [], explanation=Explanation(point, shown, level, shift * cells, spread * cells)
    )


def _rays(scene, solution, environment=None):
    """Return (N, 3) the light of a solution's lamps, traced for each texel."""
    state = solution.hypothesis
    surface = scene.image, state.lights(), state.reflectance, scene.view, scene.shadows[0], 0.2
    return shade_image(*surface, environment).light_linear


def _softly_lit(scene, solution):
    """Return a solution's environment, and (N, 3) the light of that and of its lamps."""
    state = solution.hypothesis
    surface = scene.image, state.lights(), state.reflectance, scene.view, scene.shadows[0], 0.2
    lamps, white = shade_image(*surface).lamps, LightColours.white(len(state.rows))
    environment, soft = _soft_light(scene, solution, lamps, white, _surface(scene, softly=True))
    return environment, soft + lamps.sum(0)[:, None]


def test_without_soft_light_all_is_lamps_under_constant_light(lit_face):
    solution = _solution(lit_face)
    lit = light_on_texels(lit_face, LightFound(solution, []))
    assert lit.light_linear == pytest.approx(_rays(lit_face, solution), rel=1e-6)
    assert [lamp.intensity for lamp in lit.lights] == pytest.approx([3, 1])
    assert not lit.deviation.any()
    assert lit.environment is None
    softly = _solution(lit_face, tail=[1.0, *[0.0] * 9], parts=SOFT)
    environment, light = _softly_lit(lit_face, softly)
    assert light == pytest.approx(lit.light_linear, rel=1e-6)
    assert (environment.fill, environment.bounce) == (1, 0)


def test_light_that_was_found_is_that_of_its_lamps_and_environment(lit_face):
    """Two roads to the same light: hidden parts taken from cells, and rays from each texel."""
    solution = _solution(lit_face, tail=[0.3, 0.4, 0.2, -0.1, 0.3, 0.0, 0.1, 0.0, -0.1, 0.05], parts=SOFT)
    environment, light = _softly_lit(lit_face, solution)
    again = _rays(lit_face, solution, environment)
    ratio = again / light
    assert np.std(ratio) < 0.02
    assert ratio.mean() == pytest.approx(1, abs=0.01)
    dimmer = _rays(lit_face, solution, replace(environment, bounce=0.0))
    assert again.mean() > dimmer.mean() + 0.01


def test_shadows_that_the_picture_shows_stay_and_others_go(lit_face, truth):
    solution = _solution(lit_face)
    # The same lamps, but a picture in which nothing casts a shadow.
    mask, state = truth.image.mask, solution.hypothesis
    shaded = _rays(lit_face, solution)
    casting_none = truth.image, state.lights(), state.reflectance, (0, 0, 1), None, 0.2
    open_light = shade_image(*casting_none).light_linear
    texture = truth.image.texture_linear.copy()
    texture[mask] = texture[mask] / shaded * open_light
    image = replace(truth.image, texture_linear=texture)
    other = shaded_image(image, prior=AlbedoPrior.faces(), force=("albedo.shadows",))
    traced = light_on_texels(lit_face, LightFound(solution, []))
    normal = truth.image.normal[mask]
    shadow = (traced.visible < 0.1) & (normal @ WEAK.direction > 0.1) & (normal @ STRONG.direction > 0.1)
    assert shadow.sum() > 50
    step = np.log(open_light[shadow] / shaded[shadow]).mean()
    assert step > 0.25
    # Of the step in the light that a shadow makes, most is there where the picture shows it, and only there.
    for scene, true in ((lit_face, shaded), (other, open_light)):
        off = np.log(light_on_texels(scene, _found(scene, solution)).light_linear.mean(1) / true[:, 0])
        assert np.abs(off[shadow] - np.median(off)).mean() < 0.4 * step


def test_a_highlight_leaves_light_on_skin_however_strong_it_is(lit_face):
    solution = _solution(lit_face, tail=[0.3, np.log(8.0)], parts=("specular",))
    found, texture = _found(lit_face, solution), lit_face.image.texture_linear[lit_face.image.mask]
    assert found.solution.hypothesis.reflectance.specular_strength > 0
    strong = replace(found.explanation, colours=replace(found.explanation.colours, gloss=20.0))
    lit = light_on_texels(lit_face, replace(found, explanation=strong))
    assert lit.specular.any()
    assert (lit.specular < texture).all()


def test_colours_go_with_their_lamps(lit_face):
    colors = np.array([[2.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    lit = light_on_texels(lit_face, _found(lit_face, _solution(lit_face), lamps=colors))
    strong, weak = lit.lights
    assert strong.color_linear == (1, 1, 1)
    assert weak.color_linear == pytest.approx((2, 1, 0))
    assert (weak.intensity, strong.intensity) == pytest.approx((1, 3))
    assert lit.light_linear.min() > 0
    normal = lit_face.image.normal[lit_face.image.mask]
    only_weak = (normal @ WEAK.direction > 0.3) & (normal @ STRONG.direction < -0.1)
    assert (lit.light_linear[only_weak, 0] > lit.light_linear[only_weak, 2]).all()


def test_what_other_explanations_add_is_on_every_texel(lit_face):
    solution = _solution(lit_face)
    alone, both = (
        light_on_texels(lit_face, _found(lit_face, solution, shift, 0.1)) for shift in (0.0, np.log(1.2))
    )
    assert both.light_linear == pytest.approx(1.2 * alone.light_linear)
    assert both.deviation == pytest.approx(0.1)
    assert both.lights == alone.lights


def test_colour_tells_which_part_of_a_lamp_reaches_a_texel_whose_brightness_does_not():
    mask, columns = np.ones((20, 20), bool), np.arange(400) % 20
    part = np.select([columns < 10, columns < 15], [0.0, 0.5], 1.0)
    soft = np.ones((400, 3))
    lamp = (soft * [0.02, 0.6, 1.0])[None]
    known = _Expected.__new__(_Expected)
    vars(known).update(
        point=SimpleNamespace(problem=SimpleNamespace(blur=0.1)),
        coloured=True,
        usable=mask.ravel(),
        lead=0,
        first=np.arange(3) == 0,
        level=np.zeros(400),
        ratios=np.zeros((400, 3)),
        texels=(soft + part[:, None] * lamp[0]).astype(np.float32),
    )
    # The traced shadow is known only by half: every second row.
    traced = (np.arange(400) // 20 % 2).astype(np.float32)[None]
    seen = _seen_shadows(known, mask, traced, lamp, soft)[0]
    for p in np.unique(part):
        assert seen[part == p].mean() == pytest.approx(p, abs=0.12)
