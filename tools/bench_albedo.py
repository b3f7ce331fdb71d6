"""Albedo error against CPU time: ours beside filters, spherical harmonics and the paper's objective.

    python tools/bench_albedo.py [--size 128] [--scenes NAME ...] [--peers slow] [--out DIR]

Every scene is synthetic with a known albedo and 8 bits. The "mitsuba" groups are path-traced (the set of
tests/albedo/mitsuba_scenes, always 128 texels wide), the others are from the package's own ray tracer.
Errors are of V after the best single scale: relative RMSE, what half of the texels and 95 in 100 err by at
most, and 100 x MSE, the paper's figure. "true light" divides by the true shading: noise and 8 bits are all
that is left. Prints the worst and the mean of each group of scenes, and what failed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench.judging import AlbedoScore, score
from benchmarks.albedo_peers import homomorphic, robust_harmonics
from benchmarks.light_normalization import multi_scale_retinex
from numpy.typing import NDArray
from worlds.mitsuba_scenes import load_scenes

import scan2albedo as s2a
from scan2albedo.albedo import EstimateOptions
from scan2albedo.core.arrays import FloatArray
from scan2albedo.synthetic import (
    Material,
    SyntheticScene,
    face,
    hemisphere,
    light_at,
    with_normal_error,
)

TEXTURES = ("wood", "skin", "plain")
GRAINS = (1.0, 2.5)
DIRECTIONS = ((0, 0), (30, 15), (-45, 0), (60, -10), (-20, 40))
"""Azimuth and elevation in degrees."""
MAKERS: dict[str, Callable[..., SyntheticScene]] = {"hemisphere": hemisphere, "face": face}


@dataclass(frozen=True)
class Case:
    """One scene of a group; `image` is what the methods see, `unlit` (H, W) V divided by the true light."""

    group: str
    name: str
    image: s2a.GeometryImage
    albedo_linear: NDArray[np.float32]
    lights: tuple[s2a.PointLight, ...]
    unlit: FloatArray


@dataclass(frozen=True)
class Score:
    """One method on one case.

    `light_deg` is NaN where no lights are found, or another number of them; `unclipped_percent` is the
    MSE of the texels below white, NaN where all of them are.
    """

    group: str
    case: str
    method: str
    error: AlbedoScore
    light_deg: float
    cpu_s: float
    evaluations: int
    unclipped_percent: float


def is_wanted(group: str, wanted: set[str]) -> bool:
    """Tell whether a group is named by `wanted`, whole or by its first words; by an empty set it is.

    >>> is_wanted("face clean", {"face"}), is_wanted("mitsuba face distant", {"face"})
    (True, False)
    """
    return not wanted or any(f"{group} ".startswith(f"{name} ") for name in wanted)


def synthetic_case(group: str, name: str, scene: SyntheticScene, image: s2a.GeometryImage) -> Case:
    """Return a case of the package's own renderer."""
    assert image.texture_linear is not None
    shading = np.where(image.mask, scene.shading, 1)
    unlit = np.where(image.mask, (value_of(image.texture_linear) - scene.gain * scene.specular) / shading, 0)
    return Case(group, name, image, scene.albedo_linear, scene.lights, unlit)


def mitsuba_cases(wanted: set[str]) -> Iterator[Case]:
    """Yield the path-traced scenes of the groups wanted (all when empty)."""
    for scene in load_scenes():
        group = f"mitsuba {scene.group}"
        if is_wanted(group, wanted):
            assert scene.image.texture_linear is not None
            light = np.where(scene.image.mask, scene.light_on_value, 1)
            unlit = value_of(scene.image.texture_linear) / light
            yield Case(group, scene.name, scene.image, scene.albedo_linear, scene.lights, unlit)


def cases(size: int, wanted: set[str]) -> Iterator[Case]:
    """Yield the scenes of the groups wanted (all when empty)."""
    yield from synthetic_cases(size, wanted)
    yield from mitsuba_cases(wanted)


def synthetic_cases(size: int, wanted: set[str]) -> Iterator[Case]:
    """Yield the scenes of the package's own renderer."""
    for shape, make in MAKERS.items():
        for group, noise, tilt in (("clean", 0.0, 0.0), ("noise", 0.02, 0.0), ("normals", 0.0, 3.0)):
            name = f"{shape} {group}"
            if not is_wanted(name, wanted):
                continue
            for texture in TEXTURES:
                for grain in GRAINS if group == "clean" else GRAINS[:1]:
                    for azimuth, elevation in DIRECTIONS:
                        scene = make(
                            texture=texture,
                            grain=grain,
                            size=size,
                            noise=noise,
                            lights=[light_at(azimuth, elevation)],
                        )
                        image = scene.image
                        if tilt:
                            image = with_normal_error(image, tilt, np.random.default_rng(0))
                        yield synthetic_case(name, f"{texture} {grain:g} {azimuth}/{elevation}", scene, image)
        for group, lights, material in (
            ("near", [light_at(40, 10, distance_mm=700)], Material()),
            ("gloss", [light_at(30, 10)], Material(specular_strength=0.15)),
            ("two lights", [light_at(50, 10), light_at(-40, 5, intensity=2)], Material()),
            (
                "two flashes",
                [light_at(a, 10, distance_mm=900, intensity=2) for a in (45, -45)],
                Material(specular_strength=0.1),
            ),
            ("three lights", [light_at(60), light_at(-50, 20), light_at(0, 60)], Material()),
        ):
            name = f"{shape} {group}"
            if not is_wanted(name, wanted):
                continue
            for texture in TEXTURES:
                scene = make(texture=texture, size=size, lights=lights, material=material)
                yield synthetic_case(name, texture, scene, scene.image)


def value_of(linear: NDArray) -> FloatArray:
    return np.asarray(linear, np.float64).max(axis=2)


def light_error_deg(found: tuple[s2a.PointLight, ...], true: tuple[s2a.PointLight, ...]) -> float:
    """Return the largest angle of the best pairing; NaN when the counts differ."""
    from scipy.optimize import linear_sum_assignment

    if len(found) != len(true):
        return float("nan")
    cosine = np.array([[f.direction @ t.direction for t in true] for f in found])
    rows, columns = linear_sum_assignment(-cosine)
    return float(np.degrees(np.arccos(np.clip(cosine[rows, columns], -1, 1))).max())


def scores(case: Case, peers: str | None) -> Iterator[Score]:
    image, mask = case.image, case.image.mask
    assert image.texture_linear is not None
    value, truth = value_of(image.texture_linear), value_of(case.albedo_linear)
    unclipped = mask & (image.texture_linear < 1).all(2)

    def scored(method: str, albedo: FloatArray, light: float, cpu_s: float, evaluations: int = 0) -> Score:
        pair = albedo[..., None], truth[..., None]
        below_white = nan if unclipped.sum() == mask.sum() else score(*pair, unclipped).mse
        error = score(*pair, mask)
        return Score(case.group, case.name, method, error, light, cpu_s, evaluations, below_white)

    nan = float("nan")
    yield scored("as it is", value, nan, 0.0)
    yield scored("true light", case.unlit, 0.0, 0.0)
    for method, options in (
        ("scan2albedo", EstimateOptions()),
        ("paper's objective", EstimateOptions(objective="albedo-deviation")),
    ):
        start = time.process_time()
        found = s2a.estimate_albedo(image, options=options)
        spent = time.process_time() - start
        yield scored(
            method,
            value_of(found.albedo_linear),
            light_error_deg(found.lights, case.lights),
            spent,
            found.iterations,
        )
    for method, filtered in (
        ("robust SH-2", lambda: robust_harmonics(value, image.normal, mask)),
        ("homomorphic", lambda: homomorphic(value, mask)),
        ("retinex", lambda: multi_scale_retinex(value, mask)),
    ):
        start = time.process_time()
        albedo = filtered()
        yield scored(method, albedo, nan, time.process_time() - start)
    if peers == "slow":
        # Imported here: they need Mitsuba and minutes.
        from benchmarks.albedo_peers_slow import SLOW_PEERS

        for method, peer in SLOW_PEERS.items():
            answer = peer(image, len(case.lights))
            light = light_error_deg(answer.lights, case.lights)
            yield scored(method, answer.albedo_value, light, answer.cpu_s, answer.evaluations)


def table(found: list[Score]) -> str:
    """Return one line for each group and method."""
    lines = [
        f"{'scenes':30}{'method':20}{'n':>4}{'RMSE % mean':>13}{'worst':>8}{'50 %':>8}{'worst':>8}"
        f"{'95 %':>8}{'worst':>8}{'MSE % mean':>12}{'worst':>9}{'light deg mean':>16}"
        f"{'worst':>8}{'count right':>13}{'CPU s':>8}{'evals':>8}"
    ]
    groups = dict.fromkeys((s.group, s.method) for s in found)
    groups |= dict.fromkeys(("all", s.method) for s in found)
    for group, method in groups:
        rows = [s for s in found if group in (s.group, "all") and s.method == method]
        angles = np.array([s.light_deg for s in rows])
        *of_texels, mse = (
            np.array([getattr(s.error, k) for s in rows]) for k in ("rmse", "half", "most", "mse")
        )
        errors = "".join(f"{each.mean():8.2f}{each.max():8.2f}" for each in of_texels)
        known = angles[~np.isnan(angles)]
        light = f"{known.mean():16.2f}{known.max():8.2f}" if len(known) else f"{'-':>16}{'-':>8}"
        lines.append(
            f"{group:30}{method:20}{len(rows):4d}     {errors}{mse.mean():12.4f}{mse.max():9.4f}{light}"
            f"{f'{len(known)}/{len(rows)}':>13}{np.mean([s.cpu_s for s in rows]):8.2f}"
            f"{np.mean([s.evaluations for s in rows]):8.0f}"
        )
    over = [s for s in found if not np.isnan(s.unclipped_percent)]
    if over:
        lines += ["", "scenes with texels at white, MSE % of the texels below white"]
        lines += [f"  {s.group:34}{s.case:34}{s.method:20}{s.unclipped_percent:9.4f}" for s in over]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument(
        "--scenes",
        nargs="*",
        default=[],
        help='groups, whole or by their first words, e.g. "face clean" mitsuba; all when omitted',
    )
    parser.add_argument("--peers", choices=["slow"], help="scipy's annealing and Mitsuba's gradients too")
    parser.add_argument("--out", type=Path, help="a folder for albedo_scores.csv")
    parser.add_argument("--worst", type=int, default=8, help="how many of our worst scenes to name")
    arguments = parser.parse_args()
    found: list[Score] = []
    for case in cases(arguments.size, set(arguments.scenes)):
        found += scores(case, arguments.peers)
    print(table(found))
    ours = sorted((s for s in found if s.method == "scan2albedo"), key=lambda s: -s.error.mse)
    print("\nour worst scenes")
    for s in ours[: arguments.worst]:
        print(f"  {s.group:30}{s.case:36}{s.error.mse:8.4f} %  light {s.light_deg:6.2f} deg")
    behind = [
        (s, p)
        for s in ours
        for p in found
        if (p.group, p.case) == (s.group, s.case)
        and p.method in ("robust SH-2", "homomorphic", "retinex")
        and s.error.mse > p.error.mse + 0.02
    ]
    print(f"\nbehind a filter or SH-2 by more than 0.02 points: {len(behind)} times")
    for s, p in behind[: arguments.worst]:
        print(f"  {s.group:30}{s.case:36}{s.error.mse:8.4f}  {p.method} {p.error.mse:.4f}")
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        lines = [
            "group,case,method,relative_rmse_percent,half_percent,most_percent,mse_percent,light_deg,cpu_s,evaluations,unclipped_percent"
        ]
        lines += [
            f"{s.group},{s.case},{s.method},{s.error.rmse:.6g},{s.error.half:.6g},{s.error.most:.6g},"
            f"{s.error.mse:.6g},{s.light_deg:.4g},{s.cpu_s:.4g},{s.evaluations},"
            f"{s.unclipped_percent:.6g}"
            for s in found
        ]
        (arguments.out / "albedo_scores.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
