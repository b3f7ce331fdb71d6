"""Descent, ranking of starts and the search by least squares, on scenes of an independent renderer."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.albedo.levels import brightest_around, build_level, usable_texels, value_channel
from scan2albedo.albedo.light_parameters import LightModel
from scan2albedo.albedo.light_search import LightSearch
from scan2albedo.albedo.lit_image import CONE_RAD, LitImage
from scan2albedo.albedo.residual_objective import Residual, ResidualProblem, descend, one_step
from scan2albedo.albedo.shadows import ShadowLattice
from scan2albedo.core import Budget, Meter
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import cone_directions
from scan2albedo.optimization import NormalEquations
from scan2albedo.synthetic import face, hemisphere, light_at

FAR = math.inf
OPTIONS = EstimateOptions()
VIEW = (0.0, 0.0, 1.0)
MODEL = LightModel(1, "oren-nayar", VIEW, 80.0)
PARTS = ("near_light", "roughness", "specular")


def _problem(image, size=32, budget=Budget()):
    level = build_level(image, usable_texels(image), size)
    return ResidualProblem(level, ShadowLattice(level, None, 0.2), Meter("albedo", "", budget))


def _angles_deg(estimate, directions):
    """Return the angle from each true direction to the nearest light found."""
    found = np.array([light.direction for light in estimate.lights])
    return np.degrees(np.arccos(np.clip((np.asarray(directions) @ found.T).max(1), -1, 1)))


def _start(angle_deg, intensity=1.0, model=MODEL):
    angle = math.radians(angle_deg)
    return model.from_lights(np.array([[math.sin(angle), 0, math.cos(angle)]]), np.array([intensity]))


@pytest.fixture(scope="module")
def skin(scenes):
    return scenes.scene("hemisphere", "skin", [(20, 10, 2.0, FAR)], size=96)


@pytest.fixture(scope="module")
def glossy(scenes):
    return scenes.scene("hemisphere", "skin", [(20, 10, 2.0, 400)], size=96, sigma=0.4, specular=0.15)


@pytest.mark.parametrize("parts", [{}, {"near": True, "rough": True, "specular": True}], ids=["3", "7"])
def test_descent_ends_where_scipy_does(glossy, parts):
    model = LightModel(1, "oren-nayar", VIEW, 80.0, **parts)
    problem = _problem(glossy.image)
    ours = descend(problem, model, _start(0, model=model), 60)

    def cost(x):
        point = problem.at(model, x)
        for _ in range(3):
            point.normal_equations()
        return point.cost

    bounds = list(zip(*model.bounds, strict=True))
    options = {"maxfev": 800, "xatol": 1e-5, "fatol": 1e-9, "adaptive": True}
    peers = [
        minimize(cost, x, method="Nelder-Mead", bounds=bounds, options=options)
        for x in (_start(0, model=model), ours.x)
    ]
    best = min(peer.fun for peer in peers)
    assert cost(ours.x) == pytest.approx(best, rel=2e-4)
    assert ours.cost < 0.8 * cost(_start(0, model=model))
    if not parts:
        # The descent ends where a step gains less than 1e-5 of the cost: the valley is that flat.
        assert np.linalg.norm(ours.x - peers[0].x) < 0.03


def test_descent_stays_in_bounds_and_rests_on_them(scenes, monkeypatch):
    scene = scenes.scene("hemisphere", "plain", [(30, 0, 2.0, FAR)], size=64)
    model = LightModel(1, "oren-nayar", VIEW, 80.0, near=True, rough=True, specular=True)
    lower, upper = model.bounds
    problem, tried = _problem(scene.image), []
    at = Residual.__init__

    def watched(self, *arguments, **settings):
        at(self, *arguments, **settings)
        tried.append(self)

    monkeypatch.setattr(Residual, "__init__", watched)
    start = _start(100, 200.0, model)
    solution = descend(problem, model, start, 40)
    for x in (solution.x, *(point.x for point in tried)):
        assert np.all((x >= lower) & (x <= upper))
    assert solution.cost < tried[0].cost
    assert start[2] > upper[2]
    # A distant lamp on a matte surface: nearness and highlight end at none.
    assert solution.x[3] == pytest.approx(0, abs=0.01)
    assert solution.hypothesis.reflectance.specular_strength == pytest.approx(0, abs=0.01)


class _Bowl:
    """A quadratic cost whose parameters trade for one another, least at `bottom`."""

    def __init__(self, bottom):
        self.meter, self.bottom = Meter("albedo", "", Budget()), np.asarray(bottom)
        self.matrix = np.array([[2.0, 0.5, 1.2], [0.5, 1.0, 0.6], [1.2, 0.6, 1.0]])

    def cost(self, x):
        return 1 + 0.5 * (x - self.bottom) @ self.matrix @ (x - self.bottom)

    def at(self, _, x):
        self.meter.count()
        return _BowlPoint(self, x)


class _BowlPoint:
    def __init__(self, bowl, x):
        self.bowl, self.x, self.cost = bowl, x, bowl.cost(x)

    def quadratic_model(self):
        lower, upper = MODEL.bounds
        return NormalEquations(
            self.bowl.matrix, self.bowl.matrix @ (self.x - self.bowl.bottom), lower - self.x, upper - self.x
        )

    normal_equations = quadratic_model

    def moved(self, step):
        return self.bowl.at(None, self.x + step)


def test_descent_along_a_bound_ends_at_the_least_cost_on_it():
    """A parameter that rests on its bound must not pull the others along where it would go."""
    bowl = _Bowl([0.3, 0.2, MODEL.bounds[1][2] + 1.5])
    bounds = list(zip(*MODEL.bounds, strict=True))
    peer = minimize(bowl.cost, np.zeros(3), bounds=bounds)
    assert peer.x[2] == MODEL.bounds[1][2]
    solution = descend(bowl, MODEL, np.zeros(3), 30)
    assert solution.cost == pytest.approx(peer.fun, rel=1e-5)
    assert solution.x == pytest.approx(peer.x, abs=0.01)


def test_one_step_predicts_its_cost_where_that_is_quadratic():
    bowl = _Bowl([0.3, -0.2, 0.4])
    start = np.array([0.1, 0.1, 0.1])
    ahead = one_step(bowl, MODEL, start)
    assert ahead.cost == pytest.approx(bowl.cost(ahead.x), rel=1e-12)
    assert ahead.cost - 1 < 0.2 * (bowl.cost(start) - 1)
    assert bowl.meter.evaluations == 1


def test_a_step_and_where_it_starts_have_costs_under_the_same_weights(glossy):
    """A step that leads nowhere must not seem to gain by a further round of reweighting."""
    point = _problem(glossy.image).at(MODEL, _start(50))
    for _ in range(2):
        point.normal_equations()
        assert point.moved(np.zeros(3)).cost == point.cost


def test_shadows_are_those_of_the_parameters_that_shade(scenes):
    """Parameters beyond their bounds count as the bounds, in the shading and in the shadows."""
    image = scenes.scene("bumps", "skin", [(20, 0, 2.0, FAR)], size=64).image
    level = build_level(image, usable_texels(image), 32)
    lattice = ShadowLattice(level, RayCaster(*image.occluder_mesh()), 0.2)
    problem = ResidualProblem(level, lattice, Meter("albedo", ""))
    model = LightModel(1, "oren-nayar", VIEW, 100.0)
    lower, upper = model.bounds
    for x in (np.array([2.3, 0.4, 5.0]), np.array([0.3, -2.6, 1.0])):
        outside, inside = (problem.at(model, y) for y in (x, np.clip(x, lower, upper)))
        assert outside.cost == inside.cost
        assert outside.light.max() > 1


def test_the_highlights_strength_is_in_the_unit_of_the_search(scenes):
    """Noise lifts V's median above that of the brightest channel, in which the search measures."""
    image = scenes.scene(
        "hemisphere", "plain", [(20, 10, 2.0, FAR)], size=96, specular=0.3, noise=0.04, quantize=False
    ).image
    options = EstimateOptions(force=("albedo.specular",))
    usable = usable_texels(image)
    scene = LitImage(image, usable, "oren-nayar", VIEW, options, Meter("albedo", ""))
    found = LightSearch(scene).run(1).solution.hypothesis.reflectance.specular_strength
    median = np.median(brightest_around(image.texture_linear, usable)[usable])
    assert np.median(value_channel(image.texture_linear)[usable]) > 1.01 * median
    estimate = estimate_albedo(image, 1, options=options)
    assert estimate.reflectance.specular_strength == pytest.approx(found * median, rel=1e-9)


def test_descent_costs_no_more_evaluations_than_allowed(skin):
    for allowed in (1, 2, 5):
        problem = _problem(skin.image)
        descend(problem, MODEL, _start(60), allowed)
        assert problem.meter.evaluations == allowed


def test_descent_without_budget_returns_the_start_at_infinite_cost(skin):
    problem = _problem(skin.image, budget=Budget(evaluations=3))
    problem.meter.count(3)
    x = _start(30)
    solution = descend(problem, MODEL, x, 10)
    assert solution.cost == math.inf
    assert np.array_equal(solution.x, x)
    assert problem.meter.evaluations == 3


def test_descent_stops_when_the_budget_ends_on_the_way(skin):
    problem = _problem(skin.image, budget=Budget(evaluations=4))
    solution = descend(problem, MODEL, _start(60), 30)
    assert problem.meter.evaluations == 4
    assert solution.cost < _problem(skin.image).at(MODEL, _start(60)).cost


@pytest.mark.parametrize("true", [0, 7, 19, 33])
def test_one_step_ranks_the_true_direction_first(scenes, true):
    directions = cone_directions(60, VIEW, CONE_RAD)
    x, y, z = directions[true]
    azimuth, elevation = math.degrees(math.atan2(x, z)), math.degrees(math.asin(y))
    scene = scenes.scene("hemisphere", "plain", [(azimuth, elevation, 2.0, FAR)], size=64)
    problem = _problem(scene.image)
    steps = [one_step(problem, MODEL, MODEL.from_lights(d[None], np.array([2.0]))) for d in directions]
    assert int(np.argmin([step.cost for step in steps])) == true
    assert problem.meter.evaluations == 60
    ahead = MODEL.direction(*steps[true].x[:2])
    assert math.degrees(math.acos(min(1.0, float(ahead @ directions[true])))) < 1


@pytest.mark.parametrize("kind", ["skin", "plain"])
@pytest.mark.parametrize(
    ("light", "settings", "present"),
    [
        ((30, 10, 2.0, FAR), {}, ()),
        ((30, 10, 2.0, 400), {}, ("near_light",)),
        ((35, 25, 2.0, FAR), {"sigma": 0.5}, ("roughness",)),
        ((20, 10, 2.0, FAR), {"specular": 0.2}, ("specular",)),
    ],
    ids=["matte and far", "near lamp", "rough", "glossy"],
)
def test_parts_are_found_when_present_and_left_out_when_absent(scenes, kind, light, settings, present):
    scene = scenes.scene("hemisphere", kind, [light], size=96, **settings)
    plan = estimate_albedo(scene.image, 1).plan
    assert {part: plan.ran(f"albedo.{part}") for part in PARTS} == {part: part in present for part in PARTS}
    judged = [step for step in plan for part in PARTS if step.stage == f"albedo.{part}"]
    assert all("asked)" in step.evidence for step in judged)


@pytest.fixture(scope="module")
def one_light_scenes():
    light = (light_at(40, 10),)
    return {
        "wood": hemisphere(size=96, lights=light),
        "skin": hemisphere(size=96, lights=light, texture="skin"),
        "face": face(0, size=96, lights=light),
    }


@pytest.mark.parametrize("name", ["wood", "skin", "face"])
def test_two_hundred_evaluations_are_enough(one_light_scenes, name):
    scene = one_light_scenes[name]
    errors = {}
    for evaluations in (200, 800, None):
        estimate = estimate_albedo(scene.image, 1, budget=Budget(evaluations=evaluations))
        errors[evaluations] = albedo_error(
            estimate.albedo_linear, scene.albedo_linear, scene.image.mask
        ).mse_percent
    assert errors[200] <= 0.3
    assert errors[800] == pytest.approx(errors[None], rel=0.2)
    assert errors[None] <= 0.01
    assert estimate.iterations <= 800
    assert _angles_deg(estimate, [scene.lights[0].direction])[0] < 1


@pytest.mark.parametrize("name", ["wood", "skin", "face"])
def test_one_light_is_one(one_light_scenes, name):
    estimate = estimate_albedo(one_light_scenes[name].image)
    assert len(estimate.lights) == 1
    assert estimate.iterations <= 800


@pytest.mark.parametrize(("kind", "apart_deg"), [("skin", 40), ("plain", 30)])
def test_two_lights_are_two(scenes, kind, apart_deg):
    lamps = [(-apart_deg / 2, 10, 2.0, FAR), (apart_deg / 2, 10, 1.5, FAR)]
    scene = scenes.scene("hemisphere", kind, lamps, size=96)
    estimate = estimate_albedo(scene.image)
    assert len(estimate.lights) == 2
    # Textured lamps so close trade strength for direction: each is known to a degree or two.
    assert _angles_deg(estimate, scene.light_directions).max() < {"skin": 4, "plain": 0.5}[kind]
    assert albedo_error(estimate.albedo_linear, scene.albedo, scene.image.mask).mse_percent < 0.03
    assert estimate.iterations <= 2000


def test_two_lights_on_a_face_are_two():
    lights = (light_at(-45, 10), light_at(40, 15, intensity=2.0))
    scene = face(1, size=96, lights=lights)
    estimate = estimate_albedo(scene.image)
    assert len(estimate.lights) == 2
    assert _angles_deg(estimate, [light.direction for light in lights]).max() < 3
    assert estimate.iterations <= 2000


def test_seeds_do_not_change_a_bit(glossy):
    first, second = (estimate_albedo(glossy.image, seed=seed) for seed in (0, 7))
    assert first.lights == second.lights
    assert first.residual == second.residual
    assert np.array_equal(first.albedo_linear, second.albedo_linear)
    assert np.array_equal(first.albedo_deviation, second.albedo_deviation)


def test_the_trace_never_counts_backwards_and_ends_with_the_best(one_light_scenes):
    rows = estimate_albedo(one_light_scenes["skin"].image, 1).trace.rows
    counts = [row.evaluations for row in rows]
    assert counts == sorted(counts)
    # Parts of the light that do not pay are left out at the end.
    assert rows[-1].error <= 1.06 * min(row.error for row in rows)
    assert rows[-1].error < 0.9 * rows[0].error


@pytest.mark.parametrize("brdf", ["oren-nayar", "lambert"])
def test_wherever_the_budget_ends_the_plan_has_a_row_for_every_part(skin, brdf):
    whole = estimate_albedo(skin.image, 1, brdf=brdf)
    stages = [step.stage for step in whole.plan]
    for evaluations in range(1, whole.iterations, 23):
        cut = estimate_albedo(skin.image, 1, brdf=brdf, budget=Budget(evaluations=evaluations))
        rows = [step.stage for step in cut.plan]
        assert len(rows) == len(set(rows))
        assert set(stages) - set(rows) <= {"albedo.color_guide"}


def test_a_part_the_caller_leaves_out_is_said_to_be(skin):
    options = EstimateOptions(skip=("albedo.specular",))
    for budget in (None, Budget(evaluations=100)):
        estimate = estimate_albedo(skin.image, 1, options=options, budget=budget)
        row = next(step for step in estimate.plan if step.stage == "albedo.specular")
        assert (row.ran, row.reason) == (False, "left out by the caller")
