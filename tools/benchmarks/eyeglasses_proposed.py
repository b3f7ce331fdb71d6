"""Key points proposed from frames alone beside placed ones: any pose and unit, lenses, bends, damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.eyeglasses_rims import damaged
from benchmarks.eyeglasses_scenes import SHAPES, BareFrame, own_bend
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import KEY_POINT_NAMES, find_lens_rim, propose_keypoints
from scan2albedo.geometry.mesh import without_unreferenced
from scan2albedo.geometry.rigid import random_rotation, rotation_from_vector
from scan2albedo.io import load_scan
from scan2albedo.report.eyeglasses_views import key_point_chart
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
"""What is done to a synthetic frame; the last four are those of the section `refined`."""
SEEN, UNSEEN = range(12), range(500, 508)
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


def made(kind: str, seed: int) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return a frame (V, 3), (F, 3) in mm and its key points (20, 3), NaN for those it lacks."""
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
            rim = 1 + np.arange(len(outline))
            fan = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1)], axis=1)
            dome = np.concatenate([outline.mean(0, keepdims=True) + [0, 0, 3.0], outline])
            parts.append((dome, fan))
            if kind == "thick lenses":
                parts.append((dome - [0, 0, 1.5], fan[:, ::-1]))
        vertices, faces = join(parts)
    elif kind == "own bend":
        none = np.zeros(len(faces), bool)
        bent = own_bend(BareFrame(kind, vertices, faces, none, marks), rng)
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
    return vertices[kept], faces, marks


def bench_proposed(data: Path, pictures: Path | None = None, *, tuned: bool = False) -> None:
    """Print errors of proposed key points in mm, beside what they say of themselves."""
    print(
        f"{'frames':24}{'n':>4}{'failed':>7}{'unit':>6}{'median':>8}{'90 %':>7}{'worst':>7}",
        end="",
    )
    print(f"{'missed':>8}{'extra':>7}{'in 1 s':>8}{'in 2 s':>8}{'> 2 mm, sure':>14}  worst point")
    errors = []
    for kind in KINDS:
        rows = [_judged(made(kind, seed), seed) for seed in (SEEN if tuned else UNSEEN)]
        errors += [row for row in rows if row is not None]
        _print_row(kind, rows)
    _by_name(errors)
    for file, left in PLACED.items():
        if (data / file).is_file():
            _print_real(data / file, np.array([*left, *(np.array(left[2:]) * [-1, 1, 1])]), pictures)
        else:
            print(f"{file} is left out: it is not in {data}")


def _print_real(path: Path, marks: FloatArray, pictures: Path | None) -> None:
    """Print how far proposed key points of a real frame are from placed ones, and what they say."""
    scan = load_scan(path)
    found = propose_keypoints(scan)
    off = np.linalg.norm(found.points - marks, axis=1)
    rows = [
        f"{name} {e:.1f} ({sd:.1f})"
        for name, e, sd in zip(KEY_POINT_NAMES, off, found.deviation, strict=True)
    ]
    told = f"{found.unit} a unit of mm, log odds {found.log_odds:.1f}"
    bad = ((off > 2) & (off > 2 * found.deviation)).sum()
    middle, worst = np.nanmedian(off), np.nanmax(off)
    print(f"{path.name}: {told}; median {middle:.2f}, worst {worst:.2f} mm; {bad} above 2 mm and sure")
    print("  " + ", ".join(rows))
    if pictures is not None:
        stated = {
            n: sd for n, sd in zip(KEY_POINT_NAMES, found.deviation.tolist(), strict=True) if np.isfinite(sd)
        }
        key_point_chart(scan, found.points, stated).savefig(pictures / f"proposed_{path.stem}.png")


def _judged(
    frame: tuple[FloatArray, IntArray, FloatArray], seed: int
) -> tuple[FloatArray, FloatArray, bool] | None:
    """Return errors (20,) and deviations (20,) in mm and whether the unit is right, or None for a failure."""
    vertices, faces, marks = frame
    rng = np.random.default_rng([seed, 77])
    turn, mm, shift = random_rotation(rng), list(UNITS.values())[rng.integers(4)], rng.normal(0, 100, 3)
    try:
        found = propose_keypoints(((vertices @ turn.T + shift) / mm, faces))
    except EyeglassesError:
        return None
    back = (mm * found.points - shift) @ turn
    return np.linalg.norm(back - marks, axis=1), found.deviation, bool(abs(found.mm_per_unit / mm - 1) < 0.01)


def _print_row(kind: str, rows: list) -> None:
    good = [row for row in rows if row is not None]
    if not good:
        print(f"{kind:24}{len(rows):4}{len(rows):7}", flush=True)
        return
    error, stated = np.array([row[0] for row in good]), np.array([row[1] for row in good])
    both = np.isfinite(error)
    missed, extra = ~both & np.isinf(stated), ~both & np.isfinite(stated)
    worst = KEY_POINT_NAMES[np.unravel_index(np.nanargmax(error), error.shape)[1]]
    e, s = error[both], stated[both]
    print(
        f"{kind:24}{len(rows):4}{len(rows) - len(good):7}{sum(row[2] for row in good):6}{np.median(e):8.2f}"
        f"{np.percentile(e, 90):7.2f}{e.max():7.2f}{missed.sum():8}{extra.sum():7}"
        f"{(e < s).mean():8.2f}{(e < 2 * s).mean():8.2f}{((e > 2) & (e > 2 * s)).sum():14}"
        f"  {worst}",
        flush=True,
    )


def _by_name(rows: list) -> None:
    error, stated = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    for k, name in enumerate(KEY_POINT_NAMES):
        e, s = error[:, k], stated[:, k]
        both = np.isfinite(e) & np.isfinite(s)
        e, s = e[both], s[both]
        print(
            f"  {name:22}{np.median(e):8.2f}{np.sqrt((e**2).mean()):8.2f}{e.max():8.2f}"
            f"  stated {np.median(s):.2f}, in 1 s {(e < s).mean():.2f}, 2 s {(e < 2 * s).mean():.2f}"
        )
