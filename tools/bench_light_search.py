"""The search for the light: error against evaluations, number of lights, parts left out, seeds, speed.

    python tools/bench_light_search.py [budget] [count] [seeds] [speed] [--size 128]

Every scene is synthetic with a known albedo, 8 bits. Error is 100 x MSE of V after the best single scale.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Iterator
from itertools import product

import numpy as np
from bench_albedo import light_error_deg, synthetic_case, value_of

import scan2albedo as s2a
from scan2albedo.albedo import EstimateOptions, albedo_error
from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.light_parameters import LightModel
from scan2albedo.albedo.lit_image import LitImage
from scan2albedo.albedo.node_field import Scales
from scan2albedo.albedo.paper_search import DeviationProblem
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.core import Budget, Meter
from scan2albedo.synthetic import Material, SyntheticScene, face, hemisphere, light_at

MAKERS = {"hemisphere": hemisphere, "face": face}
TEXTURES = ("wood", "skin", "plain")
BUDGETS = (100, 200, 400, 800, 2000)
APART_DEG = 25.0
PARTS = {"specular": "albedo.specular", "near": "albedo.near_light", "rough": "albedo.roughness"}


def error_percent(scene: SyntheticScene, found: s2a.AlbedoEstimate) -> float:
    truth = value_of(scene.albedo_linear)
    return albedo_error(value_of(found.albedo_linear), truth, scene.image.mask).mse_percent


def budget_scenes(size: int) -> Iterator[tuple[str, SyntheticScene]]:
    for shape, make in MAKERS.items():
        for texture in TEXTURES:
            for azimuth, elevation in ((0, 0), (30, 15), (60, -10)):
                lights = [light_at(azimuth, elevation)]
                yield f"{shape}, one light", make(texture=texture, size=size, lights=lights)
            two = [light_at(50, 10), light_at(-40, 5, intensity=2)]
            yield f"{shape}, two lights", make(texture=texture, size=size, lights=two)


def print_budgets(size: int) -> None:
    """Print the error reached within numbers of evaluations."""
    print(f"{'MSE % mean (worst) within evaluations':28}" + "".join(f"{b:>18}" for b in (*BUDGETS, "all")))
    errors: dict[str, list[list[float]]] = {}
    used: dict[str, list[int]] = {}
    for name, scene in budget_scenes(size):
        row = []
        for budget in (*BUDGETS, None):
            found = s2a.estimate_albedo(
                scene.image, budget=None if budget is None else Budget(evaluations=budget)
            )
            row.append(error_percent(scene, found))
        errors.setdefault(name, []).append(row)
        used.setdefault(name, []).append(found.iterations)
    for name, rows in errors.items():
        table = np.array(rows)
        cells = "".join(f"{m:9.4f} ({w:.4f})" for m, w in zip(table.mean(0), table.max(0), strict=True))
        print(f"{name:28}{cells}   at most {max(used[name])} used")


def count_scenes(size: int, noise: float) -> Iterator[tuple[str, SyntheticScene]]:
    """Yield 60 scenes of one to three lights at least 25 degrees apart."""
    rng = np.random.default_rng(5)
    for k in range(60):
        count = 1 + k % 3
        lights = spread_lights(rng, count)
        make = (hemisphere, face)[k // 3 % 2]
        texture = TEXTURES[k // 6 % 3]
        gloss = 0.1 if k % 4 == 3 else 0.0
        scene = make(
            texture=texture,  # type: ignore[arg-type]
            grain=(1, 2.5)[k % 2],
            size=size,
            lights=lights,
            noise=noise,
            material=Material(sigma_rad=(0.0, 0.3)[k // 2 % 2], specular_strength=gloss),
        )
        yield f"{make.__name__} {texture} {k}", scene


def spread_lights(rng: np.random.Generator, count: int) -> list[s2a.PointLight]:
    """Return lights in front of the face, no two closer than `APART_DEG`."""
    while True:
        angles = np.stack([rng.uniform(-70, 70, count), rng.uniform(-40, 50, count)], 1)
        lights = [light_at(a, e, intensity=float(rng.uniform(1, 3))) for a, e in angles]
        directions = np.array([light.direction for light in lights])
        cosine = (directions @ directions.T)[np.triu_indices(count, 1)]
        if count == 1 or cosine.max() < np.cos(np.radians(APART_DEG)):
            return lights


def print_counts(size: int) -> None:
    """Print how often the number of lights is right, and how often the odds are against absent parts."""
    for noise in (0.0, 0.01):
        right, absent, against, errors, angles = 0, 0, 0, [], []
        wrong = []
        for name, scene in count_scenes(size, noise):
            found = s2a.estimate_albedo(scene.image)
            same = len(found.lights) == len(scene.lights)
            right += same
            errors.append(error_percent(scene, found))
            angles.append(light_error_deg(found.lights, scene.lights))
            material = scene.material
            lacks = {
                "near": True,
                "rough": material.sigma_rad == 0,
                "specular": material.specular_strength == 0,
            }
            for part, lacking in lacks.items():
                absent += lacking
                against += lacking and log_odds(found, PARTS[part]) < 0
            if not same:
                wrong.append(f"{name}: {len(found.lights)} for {len(scene.lights)}, {errors[-1]:.4f} %")
        print(
            f"noise {noise:.2f}: number of lights right in {right} of 60; odds against absent parts "
            f"{against} of {absent}; MSE % mean {np.mean(errors):.4f} worst {np.max(errors):.4f}; "
            f"light deg median {np.nanmedian(angles):.2f} worst {np.nanmax(angles):.2f}"
        )
        for line in wrong:
            print(f"  {line}")


def log_odds(found: s2a.AlbedoEstimate, stage: str) -> float:
    """Return the log odds for a part of the light that the plan tells; 0 where it tells none."""
    (step,) = found.plan.of_stage(stage)
    told = re.search(r"log odds (-?[\d.]+)", step.evidence)
    return float(told[1]) if told else 0.0


def print_seeds(size: int, seeds: int = 20) -> None:
    """Print the errors over seeds of texture and noise: the search itself draws nothing at random."""
    two = [light_at(50, 10), light_at(-40, 5, intensity=2)]
    for shape, make in MAKERS.items():
        for name, lights, noise in (
            ("one light", [light_at(30, 15)], 0.0),
            ("one light, noise 0.02", [light_at(30, 15)], 0.02),
            ("two lights", two, 0.0),
            ("two lights, noise 0.02", two, 0.02),
        ):
            errors, angles, plain, right = [], [], [], 0
            for seed, texture in product(range(seeds), TEXTURES):
                scene = make(texture=texture, size=size, lights=lights, noise=noise, seed=seed)
                found = s2a.estimate_albedo(scene.image)
                errors.append(error_percent(scene, found))
                angles.append(light_error_deg(found.lights, scene.lights))
                right += len(found.lights) == len(lights)
                unlit = synthetic_case(name, texture, scene, scene.image).unlit
                truth = value_of(scene.albedo_linear)
                plain.append(albedo_error(unlit, truth, scene.image.mask).mse_percent)
            beyond = sum(error > own for error, own in zip(errors, plain, strict=True))
            print(
                f"{shape}, {name:24}MSE % mean {np.mean(errors):.4f} worst {np.max(errors):.4f} (division by "
                f"the true light {np.mean(plain):.4f} and {np.max(plain):.4f}, better in {beyond} of "
                f"{len(errors)}); light deg mean {np.nanmean(angles):.2f} worst {np.nanmax(angles):.2f}; "
                f"number right {right}"
            )


def per_second(work, seconds: float = 1.0) -> float:  # type: ignore[no-untyped-def]
    """Return how often `work` runs in a CPU second."""
    work()
    start, runs = time.process_time(), 0
    while time.process_time() - start < seconds:
        work()
        runs += 1
    return runs / (time.process_time() - start)


def print_speed() -> None:
    """Print evaluations a CPU second at 128 x 128 and the CPU seconds of whole estimates at 512 x 512."""
    scene = face(size=128, lights=[light_at(40, 10)])
    options, view = EstimateOptions(), (0.0, 0.0, 1.0)
    meter, usable = Meter("m", "u"), usable_texels(scene.image)
    prior = AlbedoPrior.faces()
    lit = LitImage(scene.image, usable, "oren-nayar", view, options, meter, prior)
    paper, problem = DeviationProblem(lit, lit.at(128).level), lit.posterior(128)
    model = LightModel(1, "oren-nayar", view, 100.0, rough=True, specular=True)
    x = model.from_lights(np.array([[0.6, 0.2, 0.77]]), np.array([2.0]))
    tabled = per_second(lambda: paper.cost(model, x, rays=False))
    start = problem.start(model, x, problem.started(Scales()))
    still = np.zeros(len(start.x))
    posterior = per_second(lambda: start.moved(still))
    sloped = per_second(lambda: start.moved(still).quadratic())
    print(
        f"evaluations a CPU second at 128 x 128: {tabled:.0f} of the paper's objective with its table, "
        f"{posterior:.0f} of the posterior, {sloped:.0f} with its normal equations"
    )
    for name, make, lights in (
        ("hemisphere, one light", hemisphere, [light_at(30)]),
        ("face, one light", face, [light_at(40, 10)]),
        ("face, two lights", face, [light_at(50, 10), light_at(-40, 5, intensity=2)]),
    ):
        scene = make(size=512, texture="skin", lights=lights)
        spent = []
        for _ in range(3):
            begin = time.process_time()
            found = s2a.estimate_albedo(scene.image)
            spent.append(time.process_time() - begin)
        print(
            f"512 x 512, {name}: {np.median(spent):.2f} s CPU, {found.iterations} evaluations, "
            f"{error_percent(scene, found):.4f} %"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", nargs="*", default=["budget", "count", "seeds", "speed"])
    parser.add_argument("--size", type=int, default=128)
    arguments = parser.parse_args()
    if "speed" in arguments.what:
        print_speed()
    if "budget" in arguments.what:
        print_budgets(arguments.size)
    if "count" in arguments.what:
        print_counts(arguments.size)
    if "seeds" in arguments.what:
        print_seeds(arguments.size)


if __name__ == "__main__":
    main()
