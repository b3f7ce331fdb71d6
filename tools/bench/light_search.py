"""The search for the light: error against evaluations, number of lights, parts left out, seeds, speed.

Every scene is synthetic with a known albedo, 128 texels wide, 8 bits. "MSE %" is 100 x MSE of V after the
best single scale. `budgets` ends the search after so many evaluations; `count` has 60 scenes of one to three
lights at least 25 degrees apart, and holds the log odds of parts that are absent ("kept out") against 0;
`seeds` are twenty of texture and noise: the search itself draws nothing at random; `speed` are CPU
seconds of whole estimates at 512 x 512.
"""

import re
from collections.abc import Iterator
from functools import partial
from itertools import product

import numpy as np

import scan2albedo as s2a
from bench.albedo import MAKERS, TEXTURES, TWO_LIGHTS, Scene, light_error_deg, value_of
from bench.runner import Bench, Case
from scan2albedo.albedo import AlbedoEstimate, albedo_error
from scan2albedo.core import Budget
from scan2albedo.core.arrays import FloatArray
from scan2albedo.synthetic import Material, SyntheticScene, face, hemisphere, light_at

SIZE = 128
BUDGETS = (100, 200, 400, 800, 2000)
"""Evaluations."""
APART_DEG = 25.0
PARTS = {"near": "albedo.near_light", "rough": "albedo.roughness", "gloss": "albedo.specular"}
"""Stages that tell the log odds of parts of the light."""


def ours(scene: SyntheticScene, evaluations: int | None = None) -> AlbedoEstimate:
    budget = None if evaluations is None else Budget(evaluations=evaluations)
    return s2a.estimate_albedo(scene.image, budget=budget)


def errors(scene: SyntheticScene, found: AlbedoEstimate | FloatArray) -> dict[str, float]:
    if isinstance(found, np.ndarray):
        return {"MSE %": mse_percent(scene, found)}
    right = len(found.lights) == len(scene.lights)
    return {
        "MSE %": mse_percent(scene, value_of(found.albedo_linear)),
        "right %": 100.0 * right,
        "light deg": light_error_deg(found.lights, scene.lights),
        "kept out %": kept_out_percent(scene.material, found),
    }


def mse_percent(scene: SyntheticScene, value: FloatArray) -> float:
    return albedo_error(value, value_of(scene.albedo_linear), scene.image.mask).mse_percent


def kept_out_percent(material: Material, found: AlbedoEstimate) -> float:
    """Return in how many of the absent parts the odds are against the part."""
    absent = {"near": True, "rough": material.sigma_rad == 0, "gloss": material.specular_strength == 0}
    odds = []
    for part, is_absent in absent.items():
        if is_absent:
            (step,) = found.plan.of_stage(PARTS[part])
            said = re.search(r"log odds (-?[\d.]+)", step.evidence)
            odds.append(float(said[1]) if said else 0.0)
    return 100 * float(np.mean(np.array(odds) < 0))


def budget_cases(quick: bool) -> Iterator[Case]:
    for shape, make in MAKERS.items():
        for texture in TEXTURES[: 1 if quick else None]:
            made = partial(make, texture=texture, size=SIZE)
            for at in ((0, 0), (30, 15), (60, -10)):
                one = partial(made, lights=[light_at(*at)])
                yield Case(f"{shape} {texture} {at[0]}/{at[1]}", one, f"{shape}, one light")
            yield Case(f"{shape} {texture} two", partial(made, lights=TWO_LIGHTS), f"{shape}, two lights")


def spread_lights(rng: np.random.Generator, count: int) -> list[s2a.PointLight]:
    """Return lights in front of the face, no two closer than `APART_DEG`."""
    while True:
        angles = np.stack([rng.uniform(-70, 70, count), rng.uniform(-40, 50, count)], 1)
        lights = [light_at(a, e, intensity=float(rng.uniform(1, 3))) for a, e in angles]
        directions = np.array([light.direction for light in lights])
        cosine = (directions @ directions.T)[np.triu_indices(count, 1)]
        if count == 1 or cosine.max() < np.cos(np.radians(APART_DEG)):
            return lights


def count_cases(quick: bool) -> Iterator[Case]:
    for noise in (0.0, 0.01):
        rng = np.random.default_rng(5)
        for k in range(6 if quick else 60):
            lights = spread_lights(rng, 1 + k % 3)
            shape = tuple(MAKERS)[k // 3 % 2]
            texture = TEXTURES[k // 6 % 3]
            gloss = 0.1 if k % 4 == 3 else 0.0
            made = partial(
                MAKERS[shape],
                texture=texture,
                grain=(1, 2.5)[k % 2],
                size=SIZE,
                lights=lights,
                noise=noise,
                material=Material(sigma_rad=(0.0, 0.3)[k // 2 % 2], specular_strength=gloss),
            )
            yield Case(f"{shape} {texture} {k} noise {noise}", made, f"noise {noise}")


def seed_cases(quick: bool) -> Iterator[Case]:
    lights = {"one light": [light_at(30, 15)], "two lights": TWO_LIGHTS}
    for (shape, make), (name, lamps), noise in product(MAKERS.items(), lights.items(), (0.0, 0.02)):
        for seed, texture in product(range(1 if quick else 20), TEXTURES):
            made = partial(make, texture=texture, size=SIZE, lights=lamps, noise=noise, seed=seed)
            group = f"{shape}, {name}, noise {noise}"
            yield Case(f"{group}, {texture} {seed}", made, group)


def large(quick: bool) -> Iterator[Case]:
    size = SIZE if quick else 512
    lights = {"one light": [light_at(40, 10)], "two lights": TWO_LIGHTS}
    yield Case("hemisphere, one light", partial(hemisphere, size=size, texture="skin", lights=[light_at(30)]))
    for name, lamps in lights.items():
        yield Case(f"face, {name}", partial(face, size=size, texture="skin", lights=lamps))


OURS = {"scan2albedo": ours}
BENCHES = {
    "budgets": Bench(
        budget_cases,
        OURS | {f"{count} evaluations": partial(ours, evaluations=count) for count in BUDGETS},
        errors,
    ),
    "count": Bench(count_cases, OURS, errors),
    "seeds": Bench(seed_cases, OURS, errors, peers={"true light": lambda scene: Scene.of(scene).unlit}),
    "speed": Bench(large, OURS, errors, summaries=(), repeats=3),
}
