"""The albedo: its error against the evaluations and the resolution of the search for the light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.albedo_peers import homomorphic, robust_harmonics
from benchmarks.light_normalization import multi_scale_retinex
from benchmarks.presets import preset_settings
from benchmarks.sweep import Cost, ErrorKind, Outcome, Peer, Setting, StageBenchmark, timed, varied, within
from scan2albedo.albedo import AlbedoEstimate, EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.core.arrays import FloatArray
from scan2albedo.synthetic import Material, SyntheticScene, face, hemisphere, light_at, with_normal_error

_SIZE, _QUICK_SIZE = 256, 48
_TWO_LIGHTS = (light_at(50, 10), light_at(-40, 5, intensity=2))
_GLOSS = Material(specular_strength=0.15)


@cache
def albedo_scenes(size: int) -> tuple[SyntheticScene, ...]:
    """Return scenes of one and two lights, near and far, skin and wood, with noise and wrong normals."""
    tilted = face(2, texture="skin", size=size, lights=[light_at(-45)])
    wrong = with_normal_error(tilted.image, 3.0, np.random.default_rng(0))
    return (
        face(0, texture="skin", size=size, lights=[light_at(30, 15)], noise=0.01),
        face(1, texture="wood", size=size, lights=[light_at(60, -10)]),
        face(3, texture="skin", size=size, lights=_TWO_LIGHTS, noise=0.005),
        face(4, texture="skin", size=size, lights=[light_at(40, 10, distance_mm=900)], material=_GLOSS),
        replace(tilted, image=wrong),
        hemisphere(texture="wood", size=size, lights=[light_at(30, 15)], noise=0.02),
    )


def _settings(quick: bool) -> list[Setting]:
    options = EstimateOptions()
    default = Setting("default", "", options)
    if quick:
        small = EstimateOptions(sizes=(16, 16, 32))
        return [
            Setting("default", "", small),
        ]
    sizes = (
        (16, 32, 128),
        (48, 64, 128),
        (32, 32, 64),
        (32, 48, 96),
        (32, 32, 128),
        (32, 64, 64),
        (32, 128, 256),
    )
    paper = Setting("objective", "the paper's", EstimateOptions(objective="albedo-deviation"))
    return [
        default,
        *preset_settings("albedo"),
        *varied("sizes", options, sizes, "{0[0]}, {0[1]} and {0[2]}".format),
        *varied("maximal_lights", options, (1, 2)),
        *within(options, (1, 25, 50, 100, 200, 400)),
        paper,
    ]


def value_of(linear: NDArray) -> FloatArray:
    """Return V (H, W) of linear colours (H, W, 3): the channel that light is found on."""
    return np.asarray(linear, np.float64).max(axis=2)


def _run(scene: SyntheticScene, setting: Setting) -> Outcome:
    def work() -> AlbedoEstimate:
        return estimate_albedo(scene.image, budget=setting.budget, options=setting.options)

    found, cost = timed(work)
    right = 100.0 * (len(found.lights) == len(scene.lights))
    return albedo_errors(
        scene, value_of(found.albedo_linear), cost, found.iterations, {"lights right %": right}
    )


def albedo_errors(
    scene: SyntheticScene,
    albedo_value: FloatArray,
    cost: Cost,
    evaluations: int = 0,
    details: dict[str, float] | None = None,
) -> Outcome:
    """Return the error of V (H, W) of an albedo after the best single scale."""
    error = albedo_error(albedo_value, value_of(scene.albedo_linear), scene.image.mask)
    return Outcome(cost, (error.mse_percent,), evaluations, details or {})


def _filter(
    method: Callable[[SyntheticScene, FloatArray], FloatArray],
) -> Callable[[SyntheticScene], Outcome]:
    def run(scene: SyntheticScene) -> Outcome:
        assert scene.image.texture_linear is not None
        value = value_of(scene.image.texture_linear)
        albedo, cost = timed(lambda: method(scene, value))
        return albedo_errors(scene, albedo, cost)

    return run


def _peers(quick: bool) -> list[Peer]:
    return [
        Peer("robust SH-2", _filter(lambda s, v: robust_harmonics(v, s.image.normal, s.image.mask))),
        Peer("homomorphic", _filter(lambda s, v: homomorphic(v, s.image.mask))),
        Peer("multi-scale retinex", _filter(lambda s, v: multi_scale_retinex(v, s.image.mask))),
    ]


def _scenes(quick: bool) -> list[SyntheticScene]:
    return list(albedo_scenes(_QUICK_SIZE)[:1] if quick else albedo_scenes(_SIZE))


BENCHMARK = StageBenchmark("albedo", (ErrorKind("albedo, MSE", "%"),), _scenes, _settings, _run, _peers)
