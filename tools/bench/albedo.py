"""Albedo of synthetic scenes: ours beside filters, spherical harmonics, the paper's objective and searches.

Every scene has a known albedo and 8 bits. `synthetic` are from the package's own ray tracer, 128 texels wide;
`mitsuba` is path-traced (the set of tests/albedo/mitsuba_scenes); `settings` are our options on six scenes of
256 texels. Errors are of V = max(R, G, B) after the best single scale, in percent: relative RMSE, what half
of the texels and 95 in 100 err by at most, and 100 x MSE, the paper's figure, also of the texels below
white alone. "true light" divides by the true shading: noise and 8 bits are all that is left. "light deg" is
the largest angle of the best pairing of lights, where their number is right. Slow: SciPy's annealing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from worlds.mitsuba_scenes import MitsubaScene, load_scenes, scene_names

import scan2albedo as s2a
from bench.judging import score
from bench.peers.filters import homomorphic, multi_scale_retinex, robust_harmonics
from bench.peers.light_search import SLOW_PEERS, PeerAnswer
from bench.runner import Bench, Case
from bench.settings import presets, varied, within
from scan2albedo.albedo import EstimateOptions
from scan2albedo.core import Budget
from scan2albedo.core.arrays import FloatArray
from scan2albedo.synthetic import (
    Material,
    SyntheticScene,
    face,
    hemisphere,
    light_at,
    with_normal_error,
)

SIZE = 128
TEXTURES = ("wood", "skin", "plain")
GRAINS = (1.0, 2.5)
DIRECTIONS = ((0, 0), (30, 15), (-45, 0), (60, -10), (-20, 40))
"""Azimuth and elevation in degrees."""
NOISE = 0.02
TILT_DEG = 3.0
"""By how much the normals are wrong in the groups "normals"."""
MAKERS: dict[str, Callable[..., SyntheticScene]] = {"hemisphere": hemisphere, "face": face}
TWO_LIGHTS = (light_at(50, 10), light_at(-40, 5, intensity=2))
FLASHES = tuple(light_at(azimuth, 10, distance_mm=900, intensity=2) for azimuth in (45, -45))
LIGHTS: dict[str, tuple[Sequence[s2a.PointLight], Material]] = {
    "near": ([light_at(40, 10, distance_mm=700)], Material()),
    "gloss": ([light_at(30, 10)], Material(specular_strength=0.15)),
    "two lights": (TWO_LIGHTS, Material()),
    "two flashes": (FLASHES, Material(specular_strength=0.1)),
    "three lights": ([light_at(60), light_at(-50, 20), light_at(0, 60)], Material()),
}
PAPER = EstimateOptions(objective="albedo-deviation")


@dataclass(frozen=True)
class Scene:
    """What the methods see, the truth, and `unlit` (H, W), V divided by the true light."""

    image: s2a.GeometryImage
    albedo_linear: NDArray[np.float32]
    lights: tuple[s2a.PointLight, ...]
    unlit: FloatArray

    @property
    def value(self) -> FloatArray:
        """(H, W) V of the texture."""
        return value_of(self.image.texture_linear)

    @classmethod
    def of(cls, scene: SyntheticScene, image: s2a.GeometryImage | None = None) -> Scene:
        """Return a scene of the package's own renderer, with another image of its surface where given."""
        image = image or scene.image
        shading = np.where(image.mask, scene.shading, 1)
        direct = value_of(image.texture_linear) - scene.gain * scene.specular
        return cls(image, scene.albedo_linear, scene.lights, np.where(image.mask, direct / shading, 0))


def value_of(linear: NDArray | None) -> FloatArray:
    """Return V (H, W) of linear colours (H, W, 3): the channel that light is found on."""
    return np.asarray(linear, float).max(axis=2)


def single_light(shape: str, texture: str, grain: float, at: tuple[float, float], noise: float) -> Scene:
    lights = [light_at(*at)]
    return Scene.of(MAKERS[shape](texture=texture, grain=grain, size=SIZE, noise=noise, lights=lights))


def tilted(make: Callable[[], SyntheticScene]) -> Scene:
    scene = make()
    return Scene.of(scene, with_normal_error(scene.image, TILT_DEG, np.random.default_rng(0)))


def many_lights(shape: str, texture: str, kind: str) -> Scene:
    lights, material = LIGHTS[kind]
    return Scene.of(MAKERS[shape](texture=texture, size=SIZE, lights=lights, material=material))


def synthetic_cases(quick: bool) -> Iterator[Case]:
    for shape in MAKERS:
        for texture in TEXTURES[: 1 if quick else None]:
            for at in DIRECTIONS[: 1 if quick else None]:
                where = f"{shape} {texture} {at[0]}/{at[1]}"
                for grain in GRAINS:
                    clean = partial(single_light, shape, texture, grain, at, 0.0)
                    yield Case(f"{where} grain {grain:g}", clean, f"{shape} clean")
                noisy = partial(single_light, shape, texture, GRAINS[0], at, NOISE)
                yield Case(f"{where} noise", noisy, f"{shape} noise")
                made = partial(
                    MAKERS[shape], texture=texture, grain=GRAINS[0], size=SIZE, lights=[light_at(*at)]
                )
                yield Case(f"{where} normals", partial(tilted, made), f"{shape} normals")
            for kind in LIGHTS:
                yield Case(
                    f"{shape} {texture} {kind}", partial(many_lights, shape, texture, kind), f"{shape} {kind}"
                )


def of_mitsuba(scene: MitsubaScene) -> Scene:
    light = np.where(scene.image.mask, scene.light_on_value, 1)
    unlit = value_of(scene.image.texture_linear) / light
    return Scene(scene.image, scene.albedo_linear, scene.lights, unlit)


def mitsuba_cases(quick: bool) -> Iterator[Case]:
    for scene in load_scenes(scene_names()[:2] if quick else None):
        yield Case(scene.name, partial(of_mitsuba, scene), scene.group)


def six_scenes(size: int) -> Iterator[Case]:
    """Yield scenes of one and two lights, near and far, skin and wood, with noise and wrong normals."""
    near = light_at(40, 10, distance_mm=900)
    glossy = Material(specular_strength=0.15)
    made: dict[str, Callable[[], SyntheticScene]] = {
        "noise": lambda: face(0, texture="skin", size=size, lights=[light_at(30, 15)], noise=0.01),
        "wood": lambda: face(1, texture="wood", size=size, lights=[light_at(60, -10)]),
        "two lights": lambda: face(3, texture="skin", size=size, lights=TWO_LIGHTS, noise=0.005),
        "near and glossy": lambda: face(4, texture="skin", size=size, lights=[near], material=glossy),
        "hemisphere": lambda: hemisphere(texture="wood", size=size, lights=[light_at(30, 15)], noise=0.02),
    }
    for name, make in made.items():
        yield Case(name, lambda make=make: Scene.of(make()))

    wrong = partial(face, 2, texture="skin", size=size, lights=[light_at(-45)])
    yield Case("wrong normals", partial(tilted, wrong))


def estimated(scene: Scene, options: EstimateOptions, budget: Budget | None = None) -> PeerAnswer:
    found = s2a.estimate_albedo(scene.image, budget=budget, options=options)
    return PeerAnswer(value_of(found.albedo_linear), found.lights, found.iterations)


def light_error_deg(found: Sequence[s2a.PointLight], true: Sequence[s2a.PointLight]) -> float:
    """Return the largest angle of the best pairing; NaN when the counts differ."""
    from scipy.optimize import linear_sum_assignment

    if len(found) != len(true):
        return float("nan")
    cosine = np.array([[f.direction @ t.direction for t in true] for f in found])
    rows, columns = linear_sum_assignment(-cosine)
    return float(np.degrees(np.arccos(np.clip(cosine[rows, columns], -1, 1))).max())


def errors(scene: Scene, answer: PeerAnswer | FloatArray) -> dict[str, float]:
    """Return the errors of an albedo's V (H, W), and what of the light was found where lights are."""
    value = answer.albedo_value if isinstance(answer, PeerAnswer) else answer
    mask = scene.image.mask
    texture = scene.image.texture_linear
    pair = value[..., None], value_of(scene.albedo_linear)[..., None]
    of = score(*pair, mask)
    row = {"RMSE %": of.rmse, "50 %": of.half, "95 %": of.most, "MSE %": of.mse}
    below_white = mask & (texture < 1).all(2)
    row["below white"] = np.nan if below_white.sum() == mask.sum() else score(*pair, below_white).mse
    if not isinstance(answer, PeerAnswer):
        return row
    right = len(answer.lights) == len(scene.lights)
    return row | {
        "light deg": light_error_deg(answer.lights, scene.lights),
        "right %": 100.0 * right,
        "evaluations": float(answer.evaluations),
    }


FILTERS = {
    "robust SH-2": lambda scene: robust_harmonics(scene.value, scene.image.normal, scene.image.mask),
    "homomorphic": lambda scene: homomorphic(scene.value, scene.image.mask),
    "retinex": lambda scene: multi_scale_retinex(scene.value, scene.image.mask),
}
SEARCHES = {
    name: lambda scene, peer=peer: peer(scene.image, len(scene.lights)) for name, peer in SLOW_PEERS.items()
}
METHODS = {
    "scan2albedo": partial(estimated, options=EstimateOptions()),
    "paper's objective": partial(estimated, options=PAPER),
}
PEERS = {
    "as it is": lambda scene: scene.value,
    "true light": lambda scene: scene.unlit,
    **FILTERS,
    **SEARCHES,
}


def settings() -> dict[str, Callable[[Scene], PeerAnswer]]:
    """Return our estimates by setting, the default first."""
    free = EstimateOptions()
    sizes = (
        (16, 32, 128),
        (48, 64, 128),
        (32, 32, 64),
        (32, 48, 96),
        (32, 32, 128),
        (32, 64, 64),
        (32, 128, 256),
    )
    options = {
        "default": free,
        **presets("albedo"),
        **varied("sizes", free, sizes),
        **varied("maximal_lights", free, (1, 2)),
        "paper's objective": PAPER,
        "small": EstimateOptions(sizes=(16, 16, 32)),
    }
    made = {name: partial(estimated, options=each) for name, each in options.items()}
    return made | within(estimated, free, (1, 25, 50, 100, 200, 400))


COMMON = {"methods": METHODS, "peers": PEERS, "score": errors, "slow": tuple(SEARCHES)}
BENCHES = {
    "synthetic": Bench(synthetic_cases, **COMMON),
    "mitsuba": Bench(mitsuba_cases, **COMMON),
    "settings": Bench(
        lambda quick: six_scenes(48 if quick else 256),
        methods=settings(),
        peers=FILTERS | SEARCHES,
        score=errors,
        slow=tuple(SEARCHES),
        quick=("small", *FILTERS),
        error="MSE %",
        warm=True,
    ),
}
