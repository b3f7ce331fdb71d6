"""Canonical frames against the truth: bent synthetic frames brought to their key points at rest.

Frames in five parts and welded, in any pose, mode "mean", with key points that turn and that only shift:
errors of vertices in mm.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from bench.judging import rms
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses import CanonicalizationOptions, bounded_biharmonic_weights, canonicalize
from scan2albedo.geometry.rigid import compose, random_rotation, transform_points
from scan2albedo.synthetic import GlassesBend, SyntheticEyeglasses, eyeglasses

BENDS = {
    "tips 8 mm out": GlassesBend(temple_spread_mm=8),
    "tips 8 mm in": GlassesBend(temple_spread_mm=-8),
    "8 mm out, bridge 2 deg": GlassesBend(temple_spread_mm=8, bridge_deg=2),
    "8 mm out, bridge -2 deg": GlassesBend(temple_spread_mm=8, bridge_deg=-2),
    "twisted 3 deg": GlassesBend(twist_deg=3),
    "extreme: 40 mm out, bridge 10 deg": GlassesBend(temple_spread_mm=40, bridge_deg=10),
    "extreme: 25 mm in, bridge -10 deg": GlassesBend(temple_spread_mm=-25, bridge_deg=-10),
    "extreme: twisted 15 deg": GlassesBend(twist_deg=15),
}


@dataclass(frozen=True)
class Posed:
    """A frame, its vertices and key points in a random pose, and the weights (V, 20)."""

    glasses: SyntheticEyeglasses
    vertices: FloatArray
    points: FloatArray
    weights: FloatArray


def posed(bend: GlassesBend, seed: int, welded: bool) -> Posed:
    glasses = eyeglasses(seed, bend=bend, welded=welded)
    weights = bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.keypoints)
    rng = np.random.default_rng(seed)
    pose = compose(random_rotation(rng), rng.normal(0, 200, 3))
    vertices, points = (transform_points(pose, p) for p in (glasses.vertices, glasses.keypoints))
    return Posed(glasses, vertices, points, weights)


def to_rest(scene: Posed, handles: Literal["turned", "translated"] = "turned") -> FloatArray:
    """Return canonical vertices (V, 3)."""
    found = canonicalize(
        [(scene.vertices, scene.glasses.faces)],
        [scene.points],
        weights=[scene.weights],
        mean_keypoints=scene.glasses.rest_keypoints,
        options=CanonicalizationOptions(mode="mean", handles=handles),
    )
    return found.frames[0].vertices


def errors(scene: Posed, found: FloatArray) -> dict[str, float]:
    off = np.linalg.norm(found - scene.glasses.rest_vertices, axis=1)
    return {"rms mm": rms(off), "largest mm": float(off.max())}


def cases(quick: bool) -> Iterator[Case]:
    for name, bend in BENDS.items():
        for seed in range(1 if quick else 5):
            for welded in (True, False):
                made = partial(posed, bend, seed, welded)
                yield Case(f"{name} {seed} {'welded' if welded else 'in parts'}", made, name)


BENCH = Bench(
    cases,
    methods={"turned": to_rest, "translated": partial(to_rest, handles="translated")},
    score=errors,
    summaries=("median", "worst"),
)
