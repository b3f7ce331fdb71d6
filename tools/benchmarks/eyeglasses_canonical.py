"""Canonical frames against the truth: bent synthetic frames brought to their key points before the bend."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses import CanonicalizationOptions, bounded_biharmonic_weights, canonicalize
from scan2albedo.geometry.rigid import compose, random_rotation, transform_points
from scan2albedo.synthetic import GlassesBend, SyntheticEyeglasses, eyeglasses

SMALL = {
    "tips 8 mm out": GlassesBend(temple_spread_mm=8),
    "tips 8 mm in": GlassesBend(temple_spread_mm=-8),
    "8 mm out, bridge 2 deg": GlassesBend(temple_spread_mm=8, bridge_deg=2),
    "8 mm out, bridge -2 deg": GlassesBend(temple_spread_mm=8, bridge_deg=-2),
    "twisted 3 deg": GlassesBend(twist_deg=3),
}
EXTREME = {
    "40 mm out, bridge 10 deg": GlassesBend(temple_spread_mm=40, bridge_deg=10),
    "25 mm in, bridge -10 deg": GlassesBend(temple_spread_mm=-25, bridge_deg=-10),
    "twisted 15 deg": GlassesBend(twist_deg=15),
}


@dataclass(frozen=True)
class Figures:
    """Errors of vertices and key points in mm, change of the volume in percent, run time in ms."""

    rms: float
    largest: float
    key_points: float
    volume_percent: float
    ms: float


def volume(vertices: FloatArray, faces: IntArray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def figures(glasses: SyntheticEyeglasses, weights: FloatArray, handles: str, seed: int) -> Figures:
    rng = np.random.default_rng(seed)
    pose = compose(random_rotation(rng), rng.normal(0, 200, 3))
    mesh = (transform_points(pose, glasses.vertices), glasses.faces)
    points = transform_points(pose, glasses.keypoints)
    options = CanonicalizationOptions(mode="mean", handles=handles)  # type: ignore[arg-type]
    begun = time.perf_counter()
    found = canonicalize(
        [mesh], [points], weights=[weights], mean_keypoints=glasses.rest_keypoints, options=options
    ).frames[0]
    ms = 1e3 * (time.perf_counter() - begun)
    error = np.linalg.norm(found.vertices - glasses.rest_vertices, axis=1)
    own = found.vertices[glasses.keypoint_vertices] - glasses.rest_keypoints
    change = volume(found.vertices, glasses.faces) / volume(glasses.rest_vertices, glasses.faces) - 1
    return Figures(
        float(np.sqrt(np.mean(error**2))), float(error.max()), float(np.abs(own).max()), 100 * change, ms
    )


def bench_canonical(seeds: int) -> None:
    print(f"{seeds} seeds, each in five parts and welded; worst of all (median), errors of vertices in mm")
    print(f"{'bend':<26}{'handles':<12}{'rms':>14}{'max':>14}{'key points':>12}{'volume %':>10}{'ms':>6}")
    for name, bend in (SMALL | EXTREME).items():
        rows: dict[str, list[Figures]] = {"turned": [], "translated": []}
        for seed in range(seeds):
            for welded in (True, False):
                glasses = eyeglasses(seed, bend=bend, welded=welded)
                weights = bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.keypoints)
                for handles, found in rows.items():
                    found.append(figures(glasses, weights, handles, seed))
        for handles, found in rows.items():
            rms, largest = ([getattr(f, key) for f in found] for key in ("rms", "largest"))
            print(
                f"{name:<26}{handles:<12}{max(rms):>6.3f} ({np.median(rms):.3f}){max(largest):>6.2f} "
                f"({np.median(largest):.2f}){max(f.key_points for f in found):>13.0e}"
                f"{max((f.volume_percent for f in found), key=abs):>10.2f}"
                f"{np.median([f.ms for f in found]):>6.0f}"
            )
    bench_lattice_effects(min(seeds, 3))


def bench_lattice_effects(seeds: int) -> None:
    """Print how much the pose in which weights are solved matters to what they deform."""
    apart, weights_apart = [], []
    for seed in range(seeds):
        glasses = eyeglasses(seed, bend=SMALL["8 mm out, bridge 2 deg"])
        reference = bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.keypoints)
        for turn in range(3):
            rng = np.random.default_rng(turn)
            pose = compose(random_rotation(rng), rng.normal(0, 100, 3))
            vertices, points = (transform_points(pose, p) for p in (glasses.vertices, glasses.keypoints))
            other = bounded_biharmonic_weights(vertices, glasses.faces, points)
            results = [
                canonicalize(
                    [glasses],
                    [glasses.keypoints],
                    weights=[w],
                    mean_keypoints=glasses.rest_keypoints,
                    options=CanonicalizationOptions(mode="mean"),
                ).frames[0]
                for w in (reference, other)
            ]
            apart.append(np.linalg.norm(results[0].vertices - results[1].vertices, axis=1).max())
            weights_apart.append(np.abs(other - reference).max())
    print(
        f"pose in which the weights are solved, {len(apart)} poses: canonical vertices differ by up to "
        f"{max(apart):.3f} mm, weights by {max(weights_apart):.2f}"
    )
