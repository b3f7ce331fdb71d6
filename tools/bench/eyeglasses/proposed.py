"""Key points proposed from a frame's shape alone, beside its own ones.

Synthetic frames in any pose and unit, whole, with lenses, bent, folded, damaged, of seeds that nothing was
chosen on, and the real ones, which were looked at, beside placed points: errors in mm, shares within one
and two stated deviations, points that were missed, or proposed where the mesh has none (extra), and how
many are more than 2 mm and two deviations off (sure).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from worlds.files import DATA

from bench.eyeglasses.rims import damaged
from bench.eyeglasses.scenes import SHAPES, fan, lensless, own_bend
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses import KEY_POINT_NAMES, ProposedKeyPoints, find_lens_rim, propose_keypoints
from scan2albedo.geometry.mesh import without_unreferenced
from scan2albedo.geometry.rigid import random_rotation, rotation_from_vector
from scan2albedo.io import load_scan
from scan2albedo.synthetic import GlassesBend, eyeglasses
from scan2albedo.synthetic.sitter import join

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
KINDS = (
    "plain",
    "lenses",
    "thick lenses",
    "bent",
    "own bend",
    "front only",
    "one temple",
    "folded",
    "gaps",
    "half",
    "holes",
    "noise",
)
"""What is done to a synthetic frame; the last four are those of the bench `eyeglasses/rims`."""
UNSEEN = range(500, 508)
_KHRONOS = (
    *((0, 56.9, -2.2), (0, 38.9, 2.4), (43, 57.5, -4.7), (5.2, 38.6, 1.9), (6.5, 23, 3), (44, 0.5, 0.9)),
    *((68, 18, -2.5), (74.9, 36.5, -3), (75, 31.3, -62.5), (68.9, 23.3, -122), (61.5, 3.2, -155.5)),
)
_GIRAUT = (
    *((0, 0, 8.4), (0, -1, 5.8), (-32.8, 0, 21), (-15.3, 0, 7.4), (-13.8, 0, -8.9), (-32.8, 0, -21)),
    *((-51.9, 0, -9), (-58, -2.8, 0.5), (np.nan,) * 3, (np.nan,) * 3, (np.nan,) * 3),
)
PLACED = {
    "sunglasses_khronos.glb": _KHRONOS,
    "frame_giraut.stl": _GIRAUT,
}
"""Key points of the left half in mm, placed on renderings with a millimetre grid, not by the rule that is
judged, but by people who know it. Both frames are symmetric about x = 0."""


@dataclass(frozen=True)
class Posed:
    """A frame in mm, its key points (20, 3), and the pose and unit in which it is shown."""

    vertices: FloatArray
    faces: IntArray
    marks: FloatArray
    turn: FloatArray
    shift: FloatArray
    mm_per_unit: float

    def propose(self) -> ProposedKeyPoints:
        shown = (self.vertices @ self.turn.T + self.shift) / self.mm_per_unit
        return propose_keypoints((shown, self.faces))

    def errors(self, found: ProposedKeyPoints) -> dict[str, float | str]:
        points = (self.mm_per_unit * found.points - self.shift) @ self.turn
        error, stated = np.linalg.norm(points - self.marks, axis=1), found.deviation
        both = np.isfinite(error)
        e, s = error[both], stated[both]
        return {
            "median mm": float(np.median(e)),
            "90 % mm": float(np.percentile(e, 90)),
            "largest mm": float(e.max()),
            "unit": float(abs(found.mm_per_unit / self.mm_per_unit - 1) < 0.01),
            "missed": float((~both & np.isinf(stated)).sum()),
            "extra": float((~both & np.isfinite(stated)).sum()),
            "in 1 s": float((e < s).mean()),
            "in 2 s": float((e < 2 * s).mean()),
            "sure": float(((e > 2) & (e > 2 * s)).sum()),
            "worst": KEY_POINT_NAMES[np.nanargmax(error)],
        }


def made(kind: str, seed: int) -> Posed:
    """Return a frame whose key points are NaN where it lacks them, in any pose and unit."""
    rng = np.random.default_rng([seed, *kind.encode()])
    bend = GlassesBend(rng.uniform(-6, 9), rng.uniform(-3, 3), rng.uniform(-4, 4))
    glasses = eyeglasses(
        seed,
        shape=list(SHAPES.values())[seed % 8 // 2] if seed % 2 else None,
        bend=bend if kind == "bent" else GlassesBend(),
        welded=seed % 3 > 0 and kind not in ("folded", "front only", "one temple"),
        nose_pads=seed % 4 > 0,
        double_bridge=seed % 5 == 0,
    )
    vertices, faces, marks = glasses.vertices, glasses.faces, glasses.keypoints
    if "lenses" in kind:
        parts = [(vertices, faces)]
        for outline in glasses.lens_outlines:
            dome, sheet = fan(outline, 3.0)
            parts.append((dome, sheet))
            if kind == "thick lenses":
                parts.append((dome - [0, 0, 1.5], sheet[:, ::-1]))
        vertices, faces = join(parts)
    elif kind == "own bend":
        bent = own_bend(lensless(kind, glasses), rng)
        vertices, marks = bent(vertices), bent(marks)
    elif kind in ("front only", "one temple", "folded"):
        vertices, marks, lost = vertices.copy(), marks.copy(), np.zeros(len(vertices), bool)
        for side, first in ((1, 2), (-1, 11)):
            hinge, own = marks[first + 5].copy(), list(range(first + 6, first + 9))
            temple = glasses.part == glasses.part[glasses.keypoint_vertices[first + 7]]
            if kind == "folded":
                turn = rotation_from_vector([0, side * np.deg2rad(rng.uniform(84, 92) + 3 * side), 0])
                pivot = hinge - [side * 2.0, 0, 5.0 + 2.0 * (side > 0)]
                vertices[temple] = (vertices[temple] - pivot) @ turn.T + pivot
                marks[own] = (marks[own] - pivot) @ turn.T + pivot
                marks[first + 5] = vertices[glasses.keypoint_vertices[first + 5]]
            elif kind == "front only" or side > 0:
                lost |= temple
                marks[own] = np.nan
                front = np.flatnonzero(~lost & (side * vertices[:, 0] > 0))
                marks[first + 5] = vertices[front[(side * vertices[front, 0]).argmax()]]
        faces = faces[~lost[faces].any(1)]
    elif kind in ("gaps", "half", "holes", "noise"):
        rims = [
            find_lens_rim(vertices, faces, middle, normal=np.array([0, 0, 1.0]))
            for middle in glasses.lens_centers
        ]
        vertices, faces = damaged(vertices, faces, rims, kind, rng)
        used = np.unique(faces)
        away = np.linalg.norm(vertices[used] - marks[:, None], axis=2).min(1)
        marks = np.where(away[:, None] < 2, marks, np.nan)
    kept, faces = without_unreferenced(vertices, faces)
    rng = np.random.default_rng([seed, 77])
    turn, mm, shift = random_rotation(rng), list(UNITS.values())[rng.integers(4)], rng.normal(0, 100, 3)
    return Posed(vertices[kept], faces, marks, turn, shift, mm)


def real(file: str) -> Posed:
    left = np.array(PLACED[file], np.float64)
    marks = np.concatenate([left, left[2:] * [-1, 1, 1]])
    scan = load_scan(DATA / file)
    return Posed(scan.vertices, scan.faces, marks, np.eye(3), np.zeros(3), 1.0)


def cases(quick: bool) -> Iterator[Case]:
    for kind in KINDS:
        for seed in UNSEEN[: 1 if quick else None]:
            yield Case(f"{kind} {seed}", partial(made, kind, seed), kind)
    for file in PLACED:
        yield Case(file, partial(real, file), "real")


BENCH = Bench(
    cases, methods={"scan2albedo": Posed.propose}, score=Posed.errors, summaries=("median", "mean", "worst")
)
