"""The light found, on every texel and in its colours, and what it does to the colours of a surface."""

from dataclasses import replace

import numpy as np
import pytest

from scan2albedo.albedo import EstimateOptions, estimate_albedo
from scan2albedo.albedo.division import divide_light
from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.light_parameters import Solution
from scan2albedo.albedo.lit_image import LightFound, LitImage
from scan2albedo.albedo.residual_objective import ResidualProblem
from scan2albedo.albedo.result import shade_image
from scan2albedo.albedo.texel_light import light_on_texels
from scan2albedo.albedo.tint import Tint, tint_on
from scan2albedo.core import Meter
from scan2albedo.core.plan import PlanStep
from scan2albedo.synthetic import face, hemisphere, light_at

STEP = PlanStep("albedo.light_colour", True, "asked for")
SOFT = ("albedo.occlusion", "albedo.bounce", "albedo.environment")


@pytest.fixture(scope="module")
def lit_face():
    image = face(0, size=64, lights=[light_at(40, 15), light_at(-50, 10, intensity=1.0)]).image
    options = EstimateOptions(force=("albedo.shadows",))
    return LitImage(image, usable_texels(image), "oren-nayar", (0, 0, 1), options, Meter("albedo", ""))


def _found(scene, colors=None, tail=(), **parts):
    """Return lamps at 40 and -50 degrees, the weaker one first, and soft light of parameters `tail`."""
    model = scene.model(2)
    for name, free in parts.items():
        model = model.with_part(name, free)
    toward = np.array([lamp.direction for lamp in (light_at(-50, 10), light_at(40, 15))])
    x = model.from_lights(toward, np.array([1.0, 3.0]))
    x[6:] = tail
    return LightFound(Solution(model, x, 0.1), 0.5, [], scene.shadows[0], colors=colors)


def _constant_path(scene, found):
    lamps = found.solution.hypothesis.lights()
    reflectance = found.solution.hypothesis.reflectance
    return shade_image(scene.image, lamps, reflectance, scene.view, found.caster, 0.2).shading


@pytest.mark.parametrize("colors", [None, np.ones((12, 3))], ids=["no colours", "white"])
def test_white_light_under_constant_ambient_light_is_the_papers(lit_face, colors):
    found = _found(lit_face, colors)
    lit = light_on_texels(lit_face, found)
    assert lit.environment is None
    assert np.array_equal(lit.light_linear, _constant_path(lit_face, found).light_linear)
    assert [lamp.color_linear for lamp in lit.lights] == [(1, 1, 1)] * 2
    assert [lamp.intensity for lamp in lit.lights] == pytest.approx([3, 1])


def test_soft_light_at_its_plain_values_is_constant_light(lit_face):
    found = _found(lit_face, tail=[1.0, 0.0, *[0.0] * 8], occlusion=True, bounce=True, environment=True)
    lit = light_on_texels(lit_face, found)
    assert lit.light_linear == pytest.approx(_constant_path(lit_face, found).light_linear, abs=1e-6)
    assert lit.environment.fill == 1
    assert lit.environment.bounce == 0


def test_colours_go_with_their_lamps(lit_face):
    colors = np.ones((12, 3))
    colors[0] = 2.0, 1.0, 0.0
    lit = light_on_texels(lit_face, _found(lit_face, colors))
    strong, weak = lit.lights
    assert strong.color_linear == (1, 1, 1)
    assert weak.color_linear == pytest.approx((2, 1, 0))
    assert weak.intensity == pytest.approx(1.0)
    assert lit.light_linear.min() > 0
    assert lit.light == pytest.approx(lit.light_linear.mean(1))


def test_light_that_was_found_is_that_of_its_lamps_and_environment(lit_face):
    """Two roads to the same light: hidden parts taken from cells, and rays from each texel."""
    tail = [0.3, 0.4, 0.2, -0.1, 0.3, 0.0, 0.1, 0.0, -0.1, 0.05]
    found = _found(lit_face, tail=tail, occlusion=True, bounce=True, environment=True)
    lit = light_on_texels(lit_face, found)
    again = shade_image(
        lit_face.image, lit.lights, lit.reflectance, lit_face.view, found.caster, 0.2, lit.environment
    ).shading.light_linear
    ratio = again / lit.light_linear
    assert np.std(ratio) < 0.02
    assert ratio.mean() == pytest.approx(1, abs=0.01)
    none = replace(lit.environment, bounce=0.0)
    dimmer = shade_image(
        lit_face.image, lit.lights, lit.reflectance, lit_face.view, found.caster, 0.2, none
    ).shading.light_linear
    assert again.mean() > dimmer.mean() + 0.01


def test_an_estimate_is_relit_by_its_own_light(monkeypatch):
    def plain(*arguments, **options):
        return divide_light(*arguments, **{**options, "shrink": False})

    monkeypatch.setattr("scan2albedo.albedo.estimate.divide_light", plain)
    image = face(0, size=64, lights=[light_at(40, 15)]).image
    options = EstimateOptions(force=SOFT, skip=("albedo.outlines", "albedo.rectification"))
    estimate = estimate_albedo(image, options=options)
    assert estimate.environment is not None
    again, mask = estimate.relit(estimate.lights, estimate.environment), image.mask
    texture = estimate.albedo_linear * estimate.shading + estimate.specular[..., None]
    off = np.linalg.norm((again - texture)[mask]) / np.linalg.norm(texture[mask])
    assert off < 0.02


def test_an_estimate_under_constant_white_light_has_no_environment():
    estimate = estimate_albedo(hemisphere(size=64, lights=[light_at(30)], texture="skin").image)
    assert estimate.environment is None
    assert not any(estimate.plan.ran(stage) for stage in SOFT)


@pytest.fixture(scope="module")
def problem(lit_face):
    level = lit_face.level(32)
    return ResidualProblem(level, lit_face.lattice(level), Meter("albedo", ""), lit_face.soft(level))


def test_white_light_has_no_tint(problem, lit_face):
    solution = _found(lit_face).solution
    assert tint_on(problem, None) is None
    assert tint_on(problem, Tint(solution, np.ones((12, 3)), STEP)) is None


def test_light_of_one_colour_tints_all_cells_alike(problem, lit_face):
    solution = _found(lit_face).solution
    color = np.array([1.2, 1.0, 0.8])
    tint = tint_on(problem, Tint(solution, np.tile(color, (12, 1)), STEP))
    assert tint == pytest.approx(np.tile(color, (len(tint), 1)))


def test_a_coloured_lamp_tints_what_it_lights(problem, lit_face):
    solution = _found(lit_face).solution
    colors = np.ones((12, 3))
    colors[1] = 1.3, 1.0, 0.7
    tint, lamp = (
        tint_on(problem, Tint(solution, colors, STEP)),
        problem.at(solution.model, solution.x).lamps[1],
    )
    dark = lamp == 0
    assert dark.any()
    assert tint[dark] == pytest.approx(np.ones((dark.sum(), 3)))
    assert (tint[~dark, 0] > tint[~dark, 2]).all()


def test_the_colour_of_white_light_is_solved_as_white(problem, lit_face):
    tint = Tint.of(problem, _found(lit_face).solution)
    assert tint_on(problem, tint) is None
