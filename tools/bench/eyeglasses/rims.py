"""Lens rims: synthetic ones against their known inner edges, damaged ones by rays and by masks.

"synthetic": four rims a seed, half of them bent. "damaged": meshes that lack two pieces of each rim (40 to
100 degrees), half of it, every other face or all of it, or are rough (0.3 mm): errors in mm from rays alone
and with masks of three views, beside stated deviations. The frame is 0.3 mm and 0.3 degrees, key points 0.4
mm off. Nothing was chosen on these frames and seeds.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from bench.eyeglasses.scenes import named, photographed
from bench.judging import rms
from bench.runner import Bench, Case
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses import LensRim, find_lens_rim, refine_lens_rim
from scan2albedo.eyeglasses.mean_keypoints import RIMS, SIDES
from scan2albedo.geometry.rasterization import polyline_distance
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.synthetic import GlassesBend, SyntheticEyeglasses, eyeglasses

BENT = GlassesBend(temple_spread_mm=8, bridge_deg=2, twist_deg=4)
DAMAGE = ("whole", "gaps", "half", "holes", "none", "noise")
UNSEEN = {f"drawn {seed}": seed for seed in range(20, 26)}
UNSEEN |= {"aviator": 21, "shield": 22, "khronos": 23, "giraut": 24}
"""Frames, and seeds of bend, cameras, masks and damage."""


def distances(points: FloatArray, outline: FloatArray) -> FloatArray:
    """Distance (P,) of each point to a closed polygon in space."""
    return polyline_distance(points, np.concatenate([outline, outline[:1]]))


@dataclass(frozen=True)
class Synthetic:
    """A frame and which of its rims is meant."""

    glasses: SyntheticEyeglasses
    side: int

    def rim(self) -> LensRim:
        glasses = self.glasses
        marks = glasses.keypoints[RIMS[self.side]]
        center = glasses.lens_centers[self.side]
        return find_lens_rim(glasses.vertices, glasses.faces, center, rim_points=marks)

    def errors(self, rim: LensRim) -> dict[str, float]:
        truth = self.glasses.lens_outlines[self.side]
        off = max(distances(rim.points, truth).max(), distances(truth, rim.points).max())
        return {"worst mm": float(off), "measured": float(rim.measured.mean())}


def synthetic_cases(quick: bool) -> Iterator[Case]:
    for seed in range(4 if quick else 40):
        for welded in (True, False):
            for side in (0, 1):
                bend = BENT if seed % 2 else GlassesBend()
                made = partial(eyeglasses, seed, welded=welded, bend=bend)
                name = f"{seed} {'welded' if welded else 'in parts'} {SIDES[side]}"
                yield Case(name, lambda made=made, side=side: Synthetic(made(), side))


@dataclass(frozen=True)
class Damaged:
    """A damaged mesh, the key points and true edge of one rim, and masks of three views."""

    vertices: FloatArray
    faces: IntArray
    marks: FloatArray
    truth: LensRim
    views: list[tuple[FloatArray, BoolArray]]

    def rim(self) -> LensRim:
        return rim_at(self.vertices, self.faces, self.marks, self.truth.normal)

    def refined(self) -> LensRim:
        return refine_lens_rim(self.rim(), self.views, rim_points=self.marks)

    def errors(self, rim: LensRim) -> dict[str, float]:
        off = distances(rim.points, self.truth.points)
        stated = np.full_like(off, np.nan) if rim.deviation is None else rim.deviation
        row = {"rms mm": rms(off), "worst mm": float(off.max()), "stated mm": rms(stated)}
        return row | {f"in {k} s": float(np.mean(off <= k * stated)) for k in (1, 2)}


def rim_at(vertices: FloatArray, faces: IntArray, marks: FloatArray, normal: FloatArray | None) -> LensRim:
    top, bridge, inner, bottom, outer = marks
    center = (top + bottom) / 4 + (bridge + inner) / 8 + outer / 4
    return find_lens_rim(vertices, faces, center, rim_points=marks, normal=normal)


@cache
def damaged_frames(name: str, seed: int) -> dict[tuple[str, int], Damaged]:
    """Return rims by damage and side, where a registration puts the frame, and somebody its key points."""
    frame = named(name)
    seen = photographed(frame, seed, glass=False)
    rng = np.random.default_rng([seed, 5])
    turn, middle = rotation_from_vector(np.deg2rad(rng.normal(0, 0.3, 3))), seen.vertices.mean(0)
    shift = middle + rng.normal(0, 0.3, 3)
    vertices, marks = ((p - middle) @ turn.T + shift for p in (seen.vertices, seen.keypoints))
    truth = [rim_at(vertices, frame.faces, marks[own], None) for own in RIMS]
    marks = marks + rng.normal(0, 0.4, marks.shape)
    views = list(zip(seen.cameras, seen.masks, strict=True))
    found = {}
    for kind in DAMAGE:
        mesh = damaged(vertices, frame.faces, truth, kind, rng)
        for side in (0, 1):
            found[kind, side] = Damaged(*mesh, marks[RIMS[side]], truth[side], views)
    return found


def damaged(
    vertices: FloatArray, faces: IntArray, rims: list[LensRim], kind: str, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Return a mesh whose rims lack two pieces, a half, every other face or all, or that is rough."""
    if kind == "noise":
        return vertices + rng.normal(0, 0.3, vertices.shape), faces
    kept = np.ones(len(faces), bool)
    for rim in rims:
        offset = vertices[faces].mean(1) - rim.points.mean(0)
        size = np.linalg.norm(rim.points - rim.points.mean(0), axis=1).mean()
        near = (np.hypot(offset[:, 0], offset[:, 1]) < 1.6 * size) & (np.abs(offset[:, 2]) < 15)
        lost = np.full(len(faces), kind == "none")
        if kind == "gaps":
            for at, half in zip(rng.uniform(-np.pi, np.pi, 2), rng.uniform(20, 50, 2), strict=True):
                angle = np.arctan2(offset[:, 1], offset[:, 0]) - at
                lost |= np.abs(np.angle(np.exp(1j * angle))) < np.deg2rad(half)
        elif kind == "half":
            lost = offset[:, 1] < rng.uniform(-5, 5)
        elif kind == "holes":
            lost = rng.random(len(faces)) < 0.5
        kept &= ~(near & lost)
    return vertices, faces[kept]


def damaged_cases(quick: bool) -> Iterator[Case]:
    for name, seed in list(UNSEEN.items())[: 1 if quick else None]:
        for kind in DAMAGE:
            for side in (0, 1):
                key = (kind, side)
                made = partial(damaged_frames, name, seed)
                yield Case(f"{name} {SIDES[side]} {kind}", lambda made=made, key=key: made()[key], kind)


BENCHES = {
    "synthetic": Bench(
        synthetic_cases,
        methods={"rays": Synthetic.rim},
        score=Synthetic.errors,
        summaries=("least", "median", "worst"),
    ),
    "damaged": Bench(
        damaged_cases,
        methods={"rays": Damaged.rim, "masks": Damaged.refined},
        score=Damaged.errors,
        summaries=("rms", "worst"),
    ),
}
