"""Fine-tuning of reflectance models: does it help, and does it ever harm?

    python tools/bench_reflectance_finetune.py [people] [table] [guards] [smoothing] [resolution] [--seeds 0]

Each run has a model, 12 pictures to tune with, 6 held out that decide what is accepted, and a third set of
10 that neither step sees. Its errors are printed: photometric, of the fitted colours against pictures
without noise, and of the albedo after the best single scale, both relative RMSE, means over pictures.
`people` prints them for each picture of the third set, beside those of the mean face, with the error of the
face relit by four lights that no picture has, after the best single scale.
Faces are painted by `scan2albedo.synthetic`, light is generated, without shadows. Times are CPU seconds.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
from worlds.environments import generated_environment
from worlds.model_faces import Surface, albedo_error, person, surface

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.operators import surface_diffusion
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    FineTuning,
    ImageObservation,
    MorphableReflectanceModel,
    VertexReflectance,
    finetune,
    fit_image,
    shade_environment,
)
from scan2albedo.reflectance.finetune import best_change, smoothed, with_change

TUNING, HELD_OUT, THIRD = 12, 6, 10
REPORTED = (0, 1, 2, 3, 4)
OTHERS = (10, 11, 12)
"""Seeds that settings were chosen on."""
NEW = (20,)
"""Seeds that nothing was chosen on, and that no other part reports."""
RELIGHTS = 4
Settings = dict[str, Any]
"""Constants of `reflectance.finetune`, by name."""


@dataclass(frozen=True)
class Shot:
    """A picture of a face, and what it would be without noise."""

    face: VertexReflectance
    observation: ImageObservation
    clean_linear: np.ndarray


@dataclass(frozen=True)
class Scenario:
    """How a run's model is learned and what its pictures suffer from."""

    learn: Callable[[int, int], MorphableReflectanceModel]
    noise: float = 0.01
    outliers: float = 0.0


@dataclass(frozen=True)
class Errors:
    """Of one model on the third set."""

    photometric: float
    albedo: float


def shots(seed: int, first: int, count: int, scenario: Scenario, levels: int) -> list[Shot]:
    """Photograph people `first` ... of a seed, each under light of their own."""
    return [shot(10_000 * (seed + 1) + first + k, scenario, levels) for k in range(count)]


def shot(number: int, scenario: Scenario, levels: int) -> Shot:
    s, rng = surface(levels), np.random.default_rng([number, 3])
    face, light = person(number, levels), project_environment(generated_environment(500_000 + number))
    clean = shade_environment(face, s.normals, s.view, light).radiance_linear
    color = clean * (1 + scenario.noise * rng.normal(size=clean.shape))
    wrong = rng.random(len(color)) < scenario.outliers
    color[wrong] = 2 * np.median(clean[s.seen]) * rng.random((int(wrong.sum()), 3))
    return Shot(face, ImageObservation(color, s.normals, s.view, s.seen), clean)


def smooth_field(s: Surface, seed: int) -> np.ndarray:
    """Return a smooth random field (V,) of standard deviation 1."""
    waves = harmonics(normalized(s.vertices - [0, 0, s.vertices[:, 2].min() - 40.0]), 8)
    field = waves @ np.random.default_rng(seed).normal(size=waves.shape[1])
    return field / field.std()


@cache
def model_with_error(seed: int, levels: int) -> MorphableReflectanceModel:
    """Learn from twelve faces whose albedo was captured with an error that all share: 15 %, with a tint."""
    s = surface(levels)
    shared = smooth_field(s, 1700 + seed)
    tints = np.stack([smooth_field(s, 1800 + 3 * seed + j) for j in range(3)], 1)
    error = np.exp(0.15 * (0.9 * shared[:, None] + 0.44 * tints) - 0.15)
    faces = [person(10_000 * (seed + 1) + 1000 + k, levels) for k in range(12)]
    return MorphableReflectanceModel.from_samples(
        [replace(face, diffuse_linear=face.diffuse_linear * error) for face in faces]
    )


@cache
def model_of_few(seed: int, levels: int) -> MorphableReflectanceModel:
    """Learn from the four of twenty-four people whose skin is nearest to the middle tone."""
    faces = [person(10_000 * (seed + 1) + 1000 + k, levels) for k in range(24)]
    tone = np.array([face.diffuse_linear.mean() for face in faces])
    near = np.argsort(np.abs(tone - np.median(tone)))[:4]
    return MorphableReflectanceModel.from_samples([faces[k] for k in near])


@cache
def model_that_is_right(seed: int, levels: int) -> MorphableReflectanceModel:
    """Learn from sixty people like those in the pictures."""
    faces = [person(10_000 * (seed + 1) + 1000 + k, levels) for k in range(60)]
    return MorphableReflectanceModel.from_samples(faces, components=20)


SCENARIOS = {
    "mean 15 % off": Scenario(model_with_error),
    "the same, noise 3 %, outliers 3 %": Scenario(model_with_error, 0.03, 0.03),
    "four people alike": Scenario(model_of_few),
    "already right": Scenario(model_that_is_right),
}


def errors(model: MorphableReflectanceModel, third: list[Shot], levels: int) -> Errors:
    photometric, albedo = [], []
    for one in third:
        fit = fit_image(one.observation, model)
        used = np.isfinite(fit.radiance_linear).all(1)
        off = np.linalg.norm((fit.radiance_linear - one.clean_linear)[used])
        photometric.append(off / np.linalg.norm(one.clean_linear[used]))
        albedo.append(albedo_error(fit.face.reflectance.diffuse_linear, one.face, levels))
    return Errors(float(np.mean(photometric)), float(np.mean(albedo)))


@cache
def before(name: str, seed: int, levels: int) -> Errors:
    scenario = SCENARIOS[name]
    return errors(scenario.learn(seed, levels), shots(seed, 300, THIRD, scenario, levels), levels)


def tuned(name: str, seed: int, settings: Settings, levels: int) -> tuple[FineTuning, Errors, float]:
    """Return what tuning made of a scenario's model, its errors, and the CPU seconds it took."""
    scenario = SCENARIOS[name]
    pictures = [one.observation for one in shots(seed, 100, TUNING, scenario, levels)]
    held_out = [one.observation for one in shots(seed, 200, HELD_OUT, scenario, levels)]
    model = scenario.learn(seed, levels)
    start = time.process_time()
    s = surface(levels)
    with patch.multiple("scan2albedo.reflectance.finetune", **settings):
        result = finetune(model, pictures, held_out, s.faces, s.vertices)
    used = time.process_time() - start
    if not result.accepted_steps:
        return result, before(name, seed, levels), used
    return result, errors(result.model, shots(seed, 300, THIRD, scenario, levels), levels), used


def print_row(name: str, seed: int, settings: Settings, levels: int) -> None:
    first = before(name, seed, levels)
    result, last, used = tuned(name, seed, settings, levels)
    steps = " ".join(f"{step:g}" for step in result.accepted_steps) or "none"
    print(
        f"{name:36}{seed:4}  {first.photometric:.4f} -> {last.photometric:.4f}   "
        f"{first.albedo:.4f} -> {last.albedo:.4f}   "
        f"{result.held_out_before:.4f} -> {result.held_out_after:.4f}  {used:5.0f} s  {steps}",
        flush=True,
    )


def reconstruction_errors(one: Shot, model: MorphableReflectanceModel, levels: int) -> np.ndarray:
    """Return (3,) relative RMSE of a model's fit to a picture: of the albedo, relit, photometric."""
    s, fit = surface(levels), fit_image(one.observation, model)
    found = fit.face.reflectance
    relit = []
    for k in range(RELIGHTS):
        light = project_environment(generated_environment(900_000 + k))
        ours, truth = (
            shade_environment(face, s.normals, s.view, light).radiance_linear[s.seen]
            for face in (found, one.face)
        )
        scale = np.sum(ours * truth) / np.sum(ours * ours)
        relit.append(np.linalg.norm(scale * ours - truth) / np.linalg.norm(truth))
    used = np.isfinite(fit.radiance_linear).all(1)
    off = np.linalg.norm((fit.radiance_linear - one.clean_linear)[used])
    photometric = off / np.linalg.norm(one.clean_linear[used])
    albedo = albedo_error(found.diffuse_linear, one.face, levels)
    return np.array([albedo, np.mean(relit), photometric])


def print_people(seeds: list[int]) -> None:
    """Print reconstructions of people with and without fine-tuning, each beside the mean face."""
    print(f"{'relative RMSE, %':<14}{'albedo':<33}{'relit':<33}photometric")
    print(f"{'person':<14}{3 * ''.join(f'{kind:>11}' for kind in ('mean face', 'not tuned', 'tuned'))}")
    for label, (name, scenario) in zip(("off", "noisy", "few", "right"), SCENARIOS.items(), strict=True):
        rows, steps = [], []
        for seed in seeds:
            model = scenario.learn(seed, 0)
            result, _, _ = tuned(name, seed, {"ROUNDS": 4}, 0)
            steps.append(len(result.accepted_steps))
            models = (model.mean_only(), model, result.model)
            for one in shots(seed, 300, THIRD, scenario, 0):
                rows.append(100 * np.stack([reconstruction_errors(one, m, 0) for m in models], 1))
                figures = "".join(f"{value:11.1f}" for value in rows[-1].ravel())
                print(f"{f'{label}_{len(rows)}':<14}{figures}", flush=True)
        found = np.array(rows)
        print(f"{f'mean_{label}':<14}{''.join(f'{value:11.1f}' for value in found.mean(0).ravel())}")
        better, worse = (
            ", ".join(str(int(count)) for count in (sign * (found[..., 2] - found[..., 1]) < 0).sum(0))
            for sign in (1, -1)
        )
        print(f"  {name}: {steps} steps accepted; better in {better}, worse in {worse} of {len(rows)}")


def print_table(seeds: list[int]) -> None:
    """Print all scenarios for each seed."""
    print(f"{'scenario':36}seed  photometric        albedo             held-out objective    CPU  steps")
    for name in SCENARIOS:
        for seed in seeds:
            print_row(name, seed, {"ROUNDS": 4}, 0)


def print_guards(seeds: list[int]) -> None:
    """Print what tuning does without anchors and without smoothing."""
    plain: Settings = {"ROUNDS": 2}
    free = plain | {"MEAN_CHANGE": 10.0, "BASIS_CHANGES": (1.0,)}
    for title, settings in {
        "as it is": plain,
        "not smoothed": plain | {"SMOOTHING_MM": 0.0},
        "not anchored": free,
        "neither anchored nor smoothed": free | {"SMOOTHING_MM": 0.0},
    }.items():
        print(title)
        for name in list(SCENARIOS)[::3]:
            for seed in seeds:
                print_row(name, seed, settings, 0)


def print_smoothing(seeds: list[int]) -> None:
    """Print what one whole change does by how far it is smoothed: errors after over before."""
    s = surface(0)
    runs = []
    for name, scenario in SCENARIOS.items():
        for seed in seeds:
            model = scenario.learn(seed, 0)
            pictures = [one.observation for one in shots(seed, 100, TUNING, scenario, 0)]
            fits = [fit_image(picture, model) for picture in pictures]
            change = best_change(model, pictures, fits, mean_change=0.1, basis_change=0.1)
            runs.append((name, seed, model, change))
    print(f"{'smoothing':>12}{'photometric':>14}{'worst':>8}{'albedo':>10}{'worst':>8}")
    for deviation in (0.0, 3.0, 6.0, 9.0, 13.0, 20.0, 30.0):
        smooth = surface_diffusion(s.vertices, s.faces, deviation)
        ratios = []
        for name, seed, model, change in runs:
            first = before(name, seed, 0)
            last = errors(
                with_change(model, smoothed(change, smooth)), shots(seed, 300, THIRD, SCENARIOS[name], 0), 0
            )
            ratios.append((last.photometric / first.photometric, last.albedo / first.albedo))
        mean, worst = np.mean(ratios, axis=0), np.max(ratios, axis=0)
        print(f"{deviation:9g} mm{mean[0]:14.3f}{worst[0]:8.3f}{mean[1]:10.3f}{worst[1]:8.3f}", flush=True)


def print_resolution(seeds: list[int]) -> None:
    """Print a run on 931 and on 3,663 vertices."""
    for levels in (0, 1):
        print(f"{len(surface(levels).vertices)} vertices")
        for seed in seeds:
            print_row(next(iter(SCENARIOS)), seed, {"ROUNDS": 2}, levels)


PARTS = {
    "people": (print_people, NEW),
    "table": (print_table, REPORTED),
    "guards": (print_guards, REPORTED[:2]),
    "smoothing": (print_smoothing, OTHERS),
    "resolution": (print_resolution, REPORTED[:1]),
}


def main() -> None:
    warnings.filterwarnings("ignore", message="the image fit stopped", category=RuntimeWarning)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", default="all", choices=[*PARTS, "all"])
    parser.add_argument("--seeds", type=int, nargs="+", help="those of each part when omitted")
    arguments = parser.parse_args()
    for part in PARTS if "all" in arguments.parts else arguments.parts:
        show, seeds = PARTS[part]
        print(f"\n{part}")
        show(arguments.seeds or list(seeds))


if __name__ == "__main__":
    main()
