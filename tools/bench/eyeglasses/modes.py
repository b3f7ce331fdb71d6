"""Canonical frames of many makers in one set, bent by curves that the package does not contain.

"set": rectangular, round and usual synthetic frames and the real ones; errors in mm from the unbent frame,
laid on it, whole and front; lens edges: largest distance from the bent one's, and height. "parts": one
frame and one bend, fronts laid on the true one: rms of what both sides share, and of what they do not.
"wires": thin frames.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from scipy.spatial import cKDTree

from bench.eyeglasses.bent_frames import (
    OWN_BENDS,
    OwnBend,
    WholeFrame,
    bend_frame,
    frames_of_many_makers,
    synthetic_frame,
)
from bench.judging import rms
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses import CanonicalizationOptions, CanonicalSet, canonicalize
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.synthetic import GlassesShape

MEAN = CanonicalizationOptions(mode="mean")
ONE_BEND = {
    "one temple 8 mm out": OwnBend(left_spread_mm=8),
    "8 mm out and in": OwnBend(left_spread_mm=8, right_spread_mm=-8),
    "9 out, 3 in, twisted": OwnBend(left_spread_mm=9, right_spread_mm=-3, twist_deg=4),
    "one half folded back": OwnBend(fold_deg=4),
}
WIRE_BEND = OwnBend(twist_deg=4, drop_mm=2, left_curl_mm=5, left_spread_mm=6)


@dataclass(frozen=True)
class Bent:
    """A frame, its bent vertices (V, 3), weights (V, 20), and its number in the set."""

    frame: WholeFrame
    vertices: FloatArray
    weights: FloatArray | None = None
    number: int = 0

    def alone(self, **changes: object) -> CanonicalSet:
        mesh, points = (self.vertices, self.frame.faces), self.frame.key_points(self.vertices)
        weights = None if self.weights is None else [self.weights]
        return canonicalize([mesh], [points], weights=weights, **changes)


@cache
def whole_set() -> tuple[Sequence[Bent], Mapping[str, CanonicalSet]]:
    """Return the frames, each bent, and the set by mode."""
    frames = frames_of_many_makers()
    bent = [bend_frame(frame, bend) for frame, bend in zip(frames, OWN_BENDS, strict=False)]
    meshes = [(v, f.faces) for f, v in zip(frames, bent, strict=True)]
    marks = [f.key_points(v) for f, v in zip(frames, bent, strict=True)]
    rng = np.random.default_rng(0)
    rough = [m + rng.normal(0, 1, m.shape) for m in marks]
    unbent = canonicalize(meshes, marks)
    weights = [frame.weights for frame in unbent.frames]
    found = {
        "unbend": unbent,
        "mean": canonicalize(meshes, marks, weights=weights, options=MEAN),
        "key points 1 mm off": canonicalize(meshes, rough, weights=weights),
    }
    parts = zip(frames, bent, weights, strict=True)
    return [Bent(*part, number=number) for number, part in enumerate(parts)], found


def laid_on(points: FloatArray, target: FloatArray) -> FloatArray:
    """Return points (N, 3) brought rigidly to a target (N, 3)."""
    return transform_points(procrustes(points, target), points)


def off(points: FloatArray, target: FloatArray) -> FloatArray:
    return np.linalg.norm(laid_on(points, target) - target, axis=1)


def of_frame(scene: Bent, found: FloatArray) -> dict[str, float]:
    frame, bent, truth = scene.frame, scene.vertices, scene.frame.vertices
    front = truth[:, 2] > truth[:, 2].max() - 25
    heights = [np.ptp(laid_on(found[rim], truth[rim])[:, 1]) for rim in frame.rims]
    return {
        "whole mm": rms(off(found, truth)),
        "front mm": rms(off(found[front], truth[front])),
        "lens edge mm": float(max(off(found[rim], bent[rim]).max() for rim in frame.rims)),
        "height": float(np.mean(heights)),
    }


def set_cases(quick: bool) -> Iterator[Case]:
    frames, _ = whole_set()
    for bent in frames:
        yield Case(bent.frame.name, lambda bent=bent: bent)


def of_set(scene: Bent, mode: str) -> FloatArray:
    return whole_set()[1][mode].frames[scene.number].vertices


def one_bend_cases(quick: bool) -> Iterator[Case]:
    for each in whole_set()[0]:
        for name, bend in ONE_BEND.items():
            made = Bent(each.frame, bend_frame(each.frame, bend), each.weights)
            yield Case(f"{each.frame.name}, {name}", lambda made=made: made, name)


def of_parts(scene: Bent, found: FloatArray) -> dict[str, float]:
    truth = scene.frame.vertices
    back = truth[:, 2].max() - truth[:, 2]
    front, temples = back < 25, back > 50
    _, mirror = cKDTree(truth * [-1, 1, 1]).query(truth)
    pose = procrustes(found[front], truth[front])
    error = transform_points(pose, found) - truth
    image = error[mirror] * [-1, 1, 1]
    row = {}
    for name, part in (("front", front), ("temples", temples)):
        for what, own in (("shared", (error + image) / 2), ("not shared", (error - image) / 2)):
            row[f"{name} {what} mm"] = rms(np.linalg.norm(own[part], axis=1))
    return row


def wires(quick: bool) -> Iterator[Case]:
    for thick in (0.5, 0.9):
        shape = GlassesShape(
            rim_width=thick, rim_depth=thick, bridge_height=thick, temple_height=thick, temple_width=thick
        )
        for double in (False, True):
            frame = synthetic_frame("wire", shape, double_bridge=double)
            made = Bent(frame, bend_frame(frame, WIRE_BEND))
            yield Case(f"{thick} mm, {'two bridges' if double else 'one bridge'}", lambda made=made: made)


def to_own_rest(scene: Bent) -> FloatArray:
    rest = scene.frame.key_points(scene.frame.vertices)
    return scene.alone(mean_keypoints=rest, options=MEAN).frames[0].vertices


def bent(scene: Bent) -> FloatArray:
    return scene.vertices


def unbent(scene: Bent) -> FloatArray:
    return scene.alone().frames[0].vertices


MODES = ("unbend", "mean", "key points 1 mm off")
BENCHES = {
    "set": Bench(set_cases, {mode: partial(of_set, mode=mode) for mode in MODES} | {"bent": bent}, of_frame),
    "parts": Bench(one_bend_cases, {"unbent": unbent, "bent": bent}, of_parts),
    "wires": Bench(
        wires,
        {"unbent": unbent, "to key points at rest": to_own_rest, "bent": bent},
        lambda scene, found: {"rms mm": rms(off(found, scene.frame.vertices))},
    ),
}
