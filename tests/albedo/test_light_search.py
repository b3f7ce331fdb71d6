"""Descent, ranking of starts and the search by least squares, on scenes of an independent renderer."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.albedo.levels import build_level, usable_texels
from scan2albedo.albedo.levenberg_marquardt import descend, promise
from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.residual_problem import Linearization, ResidualProblem
from scan2albedo.core import Budget, Meter
from scan2albedo.lighting.shadow_map import cone_directions
from scan2albedo.synthetic import face, hemisphere, light_at

FAR = math.inf
OPTIONS = EstimateOptions()
VIEW = (0.0, 0.0, 1.0)
MODEL = LightModel(1, "oren-nayar", VIEW, 80.0)
PARTS = ("near_light", "roughness", "specular")


def _problem(image, size=32, budget=Budget()):
    level = build_level(image, usable_texels(image, OPTIONS), size, OPTIONS)
    return ResidualProblem(level, None, np.array(VIEW), 0.2, 0.5, Meter("albedo", "", budget))


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
        # The second evaluation lets the reweighting, which starts from the last one's weights, settle.
        problem.linearize(model, x)
        return problem.linearize(model, x).cost

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


def test_descent_stays_in_bounds_and_rests_on_them(scenes):
    scene = scenes.scene("hemisphere", "plain", [(30, 0, 2.0, FAR)], size=64)
    model = LightModel(1, "oren-nayar", VIEW, 80.0, near=True, rough=True, specular=True)
    lower, upper = model.bounds
    problem, tried, costs = _problem(scene.image), [], []
    linearize = problem.linearize

    def watched(model, x):
        here = linearize(model, x)
        tried.append(x)
        costs.append(here.cost)
        return here

    problem.linearize = watched
    start = _start(100, 200.0, model)
    solution = descend(problem, model, start, 40)
    for x in (solution.x, *tried):
        assert np.all((x >= lower) & (x <= upper))
    assert start[2] > upper[2]
    assert solution.cost == min(costs) < costs[0]
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

    def linearize(self, _, x):
        self.meter.count()
        return Linearization(self.cost(x), self.matrix, -self.matrix @ (x - self.bottom))


def test_descent_along_a_bound_ends_at_the_least_cost_on_it():
    """A parameter that rests on its bound must not pull the others along where it would go."""
    bowl = _Bowl([0.3, 0.2, MODEL.bounds[1][2] + 1.5])
    bounds = list(zip(*MODEL.bounds, strict=True))
    peer = minimize(bowl.cost, np.zeros(3), bounds=bounds)
    assert peer.x[2] == MODEL.bounds[1][2]
    solution = descend(bowl, MODEL, np.zeros(3), 30)
    assert solution.cost == pytest.approx(peer.fun, rel=1e-5)
    assert solution.x == pytest.approx(peer.x, abs=0.01)


def test_promise_is_the_cost_at_the_step_where_that_is_quadratic():
    bowl = _Bowl([0.3, -0.2, 0.4])
    start = np.array([0.1, 0.1, 0.1])
    promised, ahead = promise(bowl, MODEL, start)
    assert promised == pytest.approx(bowl.cost(ahead), rel=1e-12)
    assert promised - 1 < 0.2 * (bowl.cost(start) - 1)
    assert bowl.meter.evaluations == 1


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
    assert solution.cost < _problem(skin.image).linearize(MODEL, _start(60)).cost


@pytest.mark.parametrize("true", [0, 7, 19, 33])
def test_promise_ranks_the_true_direction_first(scenes, true):
    directions = cone_directions(60, VIEW, OPTIONS.cone_rad)
    x, y, z = directions[true]
    azimuth, elevation = math.degrees(math.atan2(x, z)), math.degrees(math.asin(y))
    scene = scenes.scene("hemisphere", "plain", [(azimuth, elevation, 2.0, FAR)], size=64)
    problem = _problem(scene.image)
    promised = [promise(problem, MODEL, MODEL.from_lights(d[None], np.array([2.0]))) for d in directions]
    assert int(np.argmin([cost for cost, _ in promised])) == true
    assert problem.meter.evaluations == 60
    ahead = MODEL.direction(*promised[true][1][:2])
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
    assert rows[-1].error <= 1.02 * min(row.error for row in rows)
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
    options = EstimateOptions(specular=False)
    for budget in (None, Budget(evaluations=100)):
        estimate = estimate_albedo(skin.image, 1, options=options, budget=budget)
        row = next(step for step in estimate.plan if step.stage == "albedo.specular")
        assert (row.ran, row.reason) == (False, "left out by the caller")
