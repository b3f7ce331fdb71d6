"""Fine-tuning of reflectance models: does it help on people it did not see, and does it ever harm?

Each model is tuned with 12 pictures, 6 held out that decide what is accepted, and judged on each of 10
others that neither step sees: relative RMSE of the albedo and of the face relit by four lights that no
picture has, both after the best single scale, and photometric, of the fitted colours against the picture
without noise. Of the models of twelve people all share one error of 15 % ("off"; "noisy" has pictures with
3 % noise and 3 % outliers), or they were learned of four people alike ("few") or of sixty like those in the
pictures ("right"). Faces are painted by `scan2albedo.synthetic`, light is generated, without shadows.
Nothing was chosen on seed 20; `seeds` are five others.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from unittest.mock import patch

import numpy as np
from worlds.environments import generated_environment
from worlds.model_faces import albedo_error, person, scaled_error, surface

from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    ImageFit,
    ImageObservation,
    MorphableReflectanceModel,
    VertexReflectance,
    finetune,
    fit_image,
    shade_environment,
)

TUNING = 12
HELD_OUT = 6
JUDGED = 10
ROUNDS = 4
"""Fewer than by default: every model is tuned anew."""
RELIGHTS = 4
NEW = 20
"""A seed that nothing was chosen on."""
LEVELS = 0
"""Subdivisions of the face model: 931 vertices."""


@dataclass(frozen=True)
class Shot:
    """A picture of a face, what it would be without noise, and where it stands."""

    face: VertexReflectance
    observation: ImageObservation
    clean_linear: FloatArray
    kind: str
    seed: int


def shot(kind: str, seed: int, number: int) -> Shot:
    """Photograph one person of a seed under light of their own."""
    noise, outliers = (0.03, 0.03) if kind == "noisy" else (0.01, 0.0)
    number += 10_000 * (seed + 1)
    s, rng = surface(LEVELS), np.random.default_rng([number, 3])
    face, light = person(number, LEVELS), project_environment(generated_environment(500_000 + number))
    clean = shade_environment(face, s.normals, s.view, light).radiance_linear
    color = clean * (1 + noise * rng.normal(size=clean.shape))
    wrong = rng.random(len(color)) < outliers
    color[wrong] = 2 * np.median(clean[s.seen]) * rng.random((int(wrong.sum()), 3))
    return Shot(face, ImageObservation(color, s.normals, s.view, s.seen), clean, kind, seed)


def smooth_field(seed: int) -> FloatArray:
    """Return a smooth random field (V,) of standard deviation 1."""
    vertices = surface(LEVELS).vertices
    waves = harmonics(normalized(vertices - [0, 0, vertices[:, 2].min() - 40.0]), 8)
    field = waves @ np.random.default_rng(seed).normal(size=waves.shape[1])
    return field / field.std()


@cache
def model_of(kind: str, seed: int) -> MorphableReflectanceModel:
    count = {"few": 24, "right": 60}.get(kind, 12)
    faces = [person(10_000 * (seed + 1) + 1000 + k, LEVELS) for k in range(count)]
    if kind == "right":
        return MorphableReflectanceModel.from_samples(faces, components=20)
    if kind == "few":
        tone = np.array([face.diffuse_linear.mean() for face in faces])
        near = np.argsort(np.abs(tone - np.median(tone)))[:4]
        return MorphableReflectanceModel.from_samples([faces[k] for k in near])
    tints = np.stack([smooth_field(1800 + 3 * seed + j) for j in range(3)], 1)
    error = np.exp(0.15 * (0.9 * smooth_field(1700 + seed)[:, None] + 0.44 * tints) - 0.15)
    spoilt = [replace(face, diffuse_linear=face.diffuse_linear * error) for face in faces]
    return MorphableReflectanceModel.from_samples(spoilt)


@cache
def tuned(kind: str, seed: int) -> MorphableReflectanceModel:
    pictures, held_out = (
        [shot(kind, seed, first + k).observation for k in range(count)]
        for first, count in ((100, TUNING), (200, HELD_OUT))
    )
    s = surface(LEVELS)
    with patch.object(import_module("scan2albedo.reflectance.finetune"), "ROUNDS", ROUNDS):
        return finetune(model_of(kind, seed), pictures, held_out, s.faces, s.vertices).model


def fitted_by(model: Callable[[str, int], MorphableReflectanceModel], scene: Shot) -> ImageFit:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the image fit stopped", category=RuntimeWarning)
        return fit_image(scene.observation, model(scene.kind, scene.seed))


def errors(scene: Shot, fit: ImageFit) -> dict[str, float]:
    s, found = surface(LEVELS), fit.face.reflectance
    relit = []
    for k in range(RELIGHTS):
        light = project_environment(generated_environment(900_000 + k))
        pair = (
            shade_environment(face, s.normals, s.view, light).radiance_linear[s.seen]
            for face in (found, scene.face)
        )
        relit.append(scaled_error(*pair))
    used = np.isfinite(fit.radiance_linear).all(1)
    off = np.linalg.norm((fit.radiance_linear - scene.clean_linear)[used])
    return {
        "albedo %": 100 * albedo_error(found.diffuse_linear, scene.face, LEVELS),
        "relit %": 100 * float(np.mean(relit)),
        "photometric %": 100 * float(off / np.linalg.norm(scene.clean_linear[used])),
    }


def cases(seeds: tuple[int, ...], quick: bool) -> Iterator[Case]:
    for seed in seeds[: 1 if quick else None]:
        for kind in ("off",) if quick else ("off", "noisy", "few", "right"):
            for k in range(2 if quick else JUDGED):
                group = kind if len(seeds) == 1 else f"{kind}, seed {seed}"
                yield Case(f"{group} {k + 1}", partial(shot, kind, seed, 300 + k), group)


METHODS = {
    "tuned": tuned,
    "not tuned": model_of,
    "mean face": lambda kind, seed: model_of(kind, seed).mean_only(),
}
BENCHES = {
    name: Bench(
        partial(cases, seeds),
        methods={name: partial(fitted_by, model) for name, model in METHODS.items()},
        score=errors,
        quick=("tuned", "not tuned"),
        summaries=("mean",),
    )
    for name, seeds in (("people", (NEW,)), ("seeds", tuple(range(5))))
}
