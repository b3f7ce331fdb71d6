"""Fit the constants of `registration/texture_evidence.py` on synthetic people, and print what they do.

People of all tones, bearded, with glasses, pale brows or no features at all, under one or two lamps or in a
room, in colour, faded or grey. Right poses, shaken by what registration errs, stand against poses of the same
scan that may be taken for it: upside down (as it is, and refined by ICP), turned by 90 degrees, shifted 20 to
35 mm, looking aside, and refined candidates that are wrong. Weights, middles, the areas under the ROC curve
of every score are printed, and in five folds the log odds of people that were left out of the fit.

    python tools/fit_texture_evidence.py --people 100
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from benchmarks.room_light import random_colors, random_room, room_light_on
from scipy.optimize import minimize
from scipy.stats import rankdata

from scan2albedo import AnnotatedFaceModel, Budget, RawScan
from scan2albedo.core import Meter
from scan2albedo.geometry.rigid import (
    Similarity,
    compose,
    invert_rigid,
    rotation_angle_rad,
    rotation_from_vector,
)
from scan2albedo.registration import RegistrationOptions
from scan2albedo.registration.candidates import every_candidate
from scan2albedo.registration.coarse_search import coarse_poses
from scan2albedo.registration.icp import icp
from scan2albedo.registration.scan_preparation import prepared_scan
from scan2albedo.registration.template import Template
from scan2albedo.registration.texture_evidence import ColourScorer
from scan2albedo.synthetic.face_paint import PaintedFeatures, landmark_uv, paint_face
from scan2albedo.synthetic.face_shape import EXPRESSION_BUMPS, Expression
from scan2albedo.synthetic.raw_scan import Scanner, scan_of
from scan2albedo.synthetic.renderer import Material
from scan2albedo.synthetic.scenes import light_at
from scan2albedo.synthetic.sitter import Painter, sit_down
from scan2albedo.synthetic.textures import skin, smooth_noise, smoothstep

SHARES = {"flip": 0.5, "candidate": 0.25, "turn": 0.1, "shift": 0.1, "aside": 0.05}
"""Of the wrong poses, by kind."""
RIDGE, FOLDS = 0.3, 5
HAIR = np.array([[0.03, 0.02, 0.015], [0.08, 0.05, 0.03], [0.25, 0.16, 0.08], [0.35, 0.3, 0.26]])


@dataclass(frozen=True)
class Row:
    """The scores (K,) of one pose of a person's scan, and how much of each is seen; `kind` as in `poses`."""

    person: int
    kind: str
    scores: np.ndarray
    weights: np.ndarray


def painter(model: AnnotatedFaceModel, seed: int, rng: np.random.Generator, tone: float) -> Painter:
    """Return the paint of a random face: bearded, with rims of glasses, pale brows, or bare of all."""
    places = landmark_uv(model)
    features = PaintedFeatures(
        brow_thickness=rng.uniform(0.5, 1.4),
        brow_lift=rng.uniform(-0.008, 0.008),
        brow_arch=rng.uniform(-0.003, 0.008),
        brow_reach=rng.uniform(0.7, 1.1),
        lip_fullness=rng.uniform(-0.004, 0.004),
    )
    bare, bearded, glasses, pale = rng.uniform(size=4) < (0.1, 0.3, 0.2, 0.3)
    beard, paleness, thick = rng.uniform(0.3, 0.9), rng.uniform(0, 0.8), rng.uniform(0.08, 0.2)
    hair, rim = HAIR[rng.integers(len(HAIR))], rng.uniform([0.10, 0.07], [0.14, 0.10])

    def paint(uv: np.ndarray) -> np.ndarray:
        plain = skin(uv, np.random.default_rng(seed), tone=tone)
        albedo = paint_face(uv, model, np.random.default_rng(seed), tone=tone, features=features)
        if bare:
            return plain
        if pale:
            apart = ((uv[:, None] - places[17:27]) ** 2).sum(2).min(1)
            albedo += (plain - albedo) * (paleness * np.exp(-apart / (2 * 0.04**2)))[:, None]
        if bearded:
            low = smoothstep((places[33, 1] - 0.01 - uv[:, 1]) / 0.03)
            lips = np.exp(-((((uv - places[[62, 66]].mean(0)) / [0.1, 0.05]) ** 2).sum(1) ** 2))
            tufts = np.exp(0.25 * smooth_noise(uv, (120, 60), np.random.default_rng(seed + 1)))
            albedo += (hair - albedo) * np.clip(beard * low * (1 - lips) * tufts, 0, 0.95)[:, None]
        for eye in (slice(36, 42), slice(42, 48)) if glasses else ():
            around = np.linalg.norm((uv - places[eye].mean(0)) / rim, axis=1)
            albedo[np.abs(around - 1) < thick] = 0.03
        return np.clip(albedo, 0.005, 0.95)

    return paint


def person_scan(model: AnnotatedFaceModel, seed: int) -> tuple[RawScan, np.ndarray, float]:
    """Return the scan of a random person, and the pose and size that lay the model's landmarks on its own."""
    rng = np.random.default_rng([seed, 77])
    tone, names = rng.uniform(0, 1), sorted(EXPRESSION_BUMPS)
    expression: Expression = names[rng.integers(len(names))]  # type: ignore[assignment]
    sitter = sit_down(
        seed,
        expression=expression,
        expression_strength=rng.uniform(0, 1.3),
        model=model,
        tone=tone,
        face_albedo=painter(model, seed, rng, tone),
    )
    in_room = rng.uniform() < 0.4
    lamps = tuple(
        light_at(
            rng.uniform(-75, 75),
            rng.uniform(-40, 60),
            distance_mm=rng.uniform(600, 1500),
            intensity=rng.uniform(1, 5),
        )
        for _ in range(1 if in_room else rng.integers(1, 3))
    )
    options = Scanner(size=32, picture_size=300, spacing_mm=rng.uniform(3, 5), noise_mm=rng.uniform(0.2, 1))
    scan, truth = scan_of(
        sitter,
        lamps,
        Material(rng.uniform(0.2, 0.5), rng.uniform(0.03, 0.2), rng.uniform(8, 25)),
        options,
        rng,
        f"person-{seed}",
        colors=random_colors(1 + len(lamps), rng, 0.15),
        ambient=partial(room_light_on, room=random_room(rng, 0.25)) if in_room else None,
    )
    assert model.landmarks is not None
    laid = similarity(model.landmarks[17:], truth.landmarks[17:])
    return recoloured(scan, rng), invert_rigid(laid.rigid(model.front)) @ truth.model_from_scan, laid.scale


def similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """Return the similarity that lays points (N, 3) on others in the least-squares sense (Umeyama)."""
    x, y = source - source.mean(0), target - target.mean(0)
    left, stretch, right = np.linalg.svd(y.T @ x)
    stretch[2] *= np.sign(np.linalg.det(left @ right))
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    rotation, scale = left @ right, float(stretch.sum() / (x * x).sum())
    return Similarity(rotation, target.mean(0) - scale * rotation @ source.mean(0), scale)


def recoloured(scan: RawScan, rng: np.random.Generator) -> RawScan:
    """Return the scan in its colours, faded with another contrast, or grey."""
    texture, kind = scan.texture_linear, rng.uniform()
    assert texture is not None
    if kind < 0.3:
        return scan
    saturation, gamma = (0.0, 1.0) if kind < 0.45 else (rng.uniform(0.2, 1.0), rng.uniform(0.5, 1.3))
    grey = texture @ np.array([0.25, 0.6, 0.15])
    faded = np.maximum(grey[..., None] + saturation * (texture - grey[..., None]), 0) ** gamma
    return replace(scan, texture_linear=faded.astype(np.float32))


def shaken(pose: np.ndarray, rng: np.random.Generator, degrees: float, millimetres: float) -> np.ndarray:
    turn = rotation_from_vector(np.radians(degrees) * rng.normal(size=3) / np.sqrt(3))
    return compose(turn, millimetres * rng.normal(size=3) / np.sqrt(3)) @ pose


def turned(pose: np.ndarray, axis: list[float], degrees: float, center: list[float]) -> np.ndarray:
    rotation, middle = rotation_from_vector(np.radians(degrees) * np.array(axis)), np.array(center)
    return compose(rotation, middle - rotation @ middle) @ pose


def poses(
    scan: RawScan, right: np.ndarray, scale: float, template: Template, rng: np.random.Generator
) -> Iterator[tuple[str, np.ndarray, float]]:
    """Yield kind, model_from_scan and scale of poses of a scan, right ones and wrong ones."""
    for _ in range(4):
        yield "right", shaken(right, rng, 4, 5), scale * np.exp(0.03 * rng.normal())
    center = [0, rng.uniform(-10, 10), 0]
    flips = [
        shaken(turned(right, [0, 0, 1], 180 + wide * rng.uniform(-25, 25), center), rng, 5, 8)
        for wide in (0, 1)
    ]
    for angle in (90, 270):
        yield "turn", shaken(turned(right, [0, 0, 1], angle, center), rng, 5, 8), scale
    for shift in ([0, 30, 0], [0, -30, 0], [rng.uniform(20, 35) * rng.choice([-1, 1]), rng.normal() * 10, 0]):
        yield "shift", compose(np.eye(3), shift) @ shaken(right, rng, 3, 3), scale
    for angle in (-70, 70):
        yield "aside", shaken(turned(right, [0, 1, 0], angle, [0, 0, -70]), rng, 5, 8), scale
    options = RegistrationOptions()
    prepared = prepared_scan(scan, options)
    few = template.first(400)
    for flip in flips:
        yield "flip", flip, scale
        placed = prepared.prepared_from_scan @ invert_rigid(flip)
        start = Similarity.of_rigid(placed, scale, template.front)
        refined = icp(prepared.samples, few, start, np.geomspace(6.0, 3.0, 25)).pose
        yield "flip", invert_rigid(refined.rigid(template.front)) @ prepared.prepared_from_scan, refined.scale
    meter = Meter("icp", "mm", Budget.of(None), None)
    starts = coarse_poses(prepared, template, options, meter, 0)
    for candidate in every_candidate(prepared, template, starts, options, meter):
        pose = invert_rigid(candidate.pose.rigid(template.front)) @ prepared.prepared_from_scan
        apart = pose @ invert_rigid(right)
        degrees, away = np.degrees(rotation_angle_rad(apart[:3, :3])), np.linalg.norm(apart[:3, 3])
        if degrees < 10 and away < 12:
            yield "right", pose, candidate.pose.scale
        elif degrees > 15 or away > 18:
            yield "candidate", pose, candidate.pose.scale


def measured(people: int) -> tuple[list[str], list[Row]]:
    """Return the names of the scores, and the rows of all people."""
    model = AnnotatedFaceModel.default()
    template = Template.of(model, 0)
    names, rows = list[str](), list[Row]()
    for person in range(people):
        scan, right, scale = person_scan(model, person)
        witness = ColourScorer.of(scan, model)
        assert witness is not None
        for kind, pose, size in poses(scan, right, scale, template, np.random.default_rng(person)):
            found = witness.scores(pose, size)
            if found is not None:
                names = list(found[0])
                rows.append(Row(person, kind, *(np.array([part[n] for n in names]) for part in found)))
    return names, rows


@dataclass(frozen=True)
class Fit:
    """log odds = sum_k weights_k seen_k (score_k - middles_k)."""

    weights: np.ndarray
    middles: np.ndarray

    @classmethod
    def of(cls, rows: list[Row]) -> Fit:
        """Fit by ridge logistic regression, right and wrong poses counting alike."""
        scores, seen = np.array([r.scores for r in rows]), np.array([r.weights for r in rows])
        right, share = np.array([r.kind == "right" for r in rows]), importance(rows)
        middles = sum(
            np.average(scores[part], axis=0, weights=share[part][:, None] * seen[part] + 1e-9) / 2
            for part in (right, ~right)
        )
        columns = np.column_stack([np.ones(len(rows)), seen * (scores - middles)])

        def cost(b: np.ndarray) -> float:
            z = columns @ b
            return float(share @ (np.logaddexp(0, z) - right * z) + RIDGE * (b[1:] ** 2).sum() / 2)

        offset, *weights = minimize(cost, np.zeros(columns.shape[1])).x
        return cls(np.array(weights), middles - offset / np.sum(weights))

    def log_odds(self, rows: list[Row]) -> np.ndarray:
        """Return (N,) of rows."""
        scores, seen = np.array([r.scores for r in rows]), np.array([r.weights for r in rows])
        return (seen * (scores - self.middles)) @ self.weights


def importance(rows: list[Row]) -> np.ndarray:
    """Return (N,) weights of rows: each person counts one right and one wrong pose, these by `SHARES`."""
    counts: dict[tuple[int, str], int] = {}
    for row in rows:
        counts[row.person, row.kind] = counts.get((row.person, row.kind), 0) + 1
    return np.array([SHARES.get(r.kind, 1.0) / counts[r.person, r.kind] for r in rows])


def area(right: np.ndarray, wrong: np.ndarray) -> float:
    """Return the area under the ROC curve."""
    ranks = rankdata(np.concatenate([right, wrong]))[: len(right)]
    return float((ranks.sum() - len(right) * (len(right) + 1) / 2) / (len(right) * len(wrong)))


def main() -> None:
    """Measure, fit and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--people", type=int, default=100)
    names, rows = measured(parser.parse_args().people)
    kinds, values = np.array([r.kind for r in rows]), np.array([r.scores for r in rows])
    left_out = np.zeros(len(rows))
    for fold in range(FOLDS):
        inside = np.array([r.person % FOLDS == fold for r in rows])
        known = [row for row, out in zip(rows, inside, strict=True) if not out]
        left_out[inside] = Fit.of(known).log_odds([r for r, out in zip(rows, inside, strict=True) if out])
    fit = Fit.of(rows)
    print("_WEIGHTS =", {n: round(float(v), 1) for n, v in zip(names, fit.weights, strict=True)})
    print("_MIDDLES =", {n: round(float(v), 2) for n, v in zip(names, fit.middles, strict=True)})
    right = kinds == "right"
    print(f"\n{'mean, area':12}", *(f"{n:>11}" for n in (*names, "log odds")))
    for kind in ("right", *SHARES):
        here = kinds == kind
        columns = [*values.T, left_out]
        cells = [f"{c[here].mean():+.2f} {area(c[right], c[here]):.3f}" for c in columns]
        print(f"{kind:12}", *(f"{cell:>11}" for cell in cells))
    print("\nlog odds: percentiles 1, 5, 25, 50, 75, 95, 99, and the share above 0")
    for kind in ("right", *SHARES):
        here = left_out[kinds == kind]
        print(
            f"{kind:12}",
            *np.percentile(here, [1, 5, 25, 50, 75, 95, 99]).round(1),
            f"{(here > 0).mean():.3f}",
        )
    print("\nstated log odds, and those of the poses there")
    share = importance(rows)
    for low in np.arange(-3.5, 3.5):
        here = (left_out >= low) & (left_out < low + 1)
        good, bad = share[here & right].sum(), share[here & ~right].sum()
        print(f"{low + 0.5:+.0f}: {np.log((good + 0.5) / (bad + 0.5)):+.1f} ({good + bad:.0f})")


if __name__ == "__main__":
    main()
