"""Fits how the cues of a pose are weighed to the probability that it is that of a face.

    OMP_NUM_THREADS=1 python tools/calibrate_registration.py [--scans 200] [--first 0] [--jobs 2]
        [--keep cues.npz]

Of each kind of scan, so many are drawn: people in raw stereo, as measured and worse, light-stage people too,
clean people, and as what is not a face scraps, reliefs, bodies, heaps of solids and gratings. The poses that
the search looks at are judged by the truth, and `scan2albedo.registration.evidence` gets the weights that
this prints: those of a logistic regression whose signs are given. Every second scan judges the weights
fitted to the others. No scan is among those of tools/bench_door.py, though its light-stage people are other
mixtures of the same five; the weight of scraps, and how noise counts (`relief`), were chosen with the first
140 of its parts in sight.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from benchmarks.door_scans import (
    UNSEEN,
    Case,
    face_case,
    light_stage_person,
    random_body,
    random_relief,
    scrap,
)
from benchmarks.stereo_scan import StereoScanner, stereo_scan
from scipy.optimize import minimize

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import Budget, Meter, RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rigid import (
    compose,
    invert_rigid,
    random_rotation,
    rotation_angle_rad,
    transform_points,
)
from scan2albedo.registration.candidates import ranked_candidates
from scan2albedo.registration.coarse_search import coarse_poses
from scan2albedo.registration.evidence import colour_scorer
from scan2albedo.registration.inputs import RegistrationOptions, Template, prepared_scan

SIGNS = {"relief": 1, "distance": -1, "share": 1}
RIGHT_DEG, RIGHT_MM = 10.0, 15.0
NEARLY_DEG, NEARLY_MM = 20.0, 30.0
"""Poses within these and not within the others are neither right nor wrong, and are left out."""
SIZE_SD = 0.07
WRONG_POSE_WEIGHT = 0.2
"""Of a wrong pose on a scan that has a right one: there are several of each."""
RIDGE = 0.0003
HARD = StereoScanner(noise_mm=(1.0, 6.0), holes=(10, 60), reach_mm=(70.0, 170.0))
SCRAP_WEIGHT = 2.0
"""Of poses on scraps, which resemble faces most."""


@dataclass(frozen=True)
class Row:
    """The cues of a pose, and whether it is right; None for nearly."""

    kind: str
    seed: int
    cues: tuple[float, ...]
    right: bool | None


def _sized(case: Case, rng: np.random.Generator) -> Case:
    """Return the case with a face of another size."""
    factor = float(np.exp(np.clip(rng.normal(scale=SIZE_SD), -0.2, 0.2)))
    assert case.model_from_scan is not None
    assert case.landmarks is not None
    pose = case.model_from_scan.copy()
    pose[:3, 3] *= factor
    scan = RawScan(case.scan.vertices * factor, case.scan.faces, name=case.scan.name)
    return Case(scan, case.kinds, pose, case.landmarks * factor)


def _person(seed: int, rng: np.random.Generator) -> Case:
    return _sized(face_case(*stereo_scan(seed)), rng)


def _hard_person(seed: int, rng: np.random.Generator) -> Case:
    return _sized(face_case(*stereo_scan(seed, scanner=HARD)), rng)


def _clean_person(seed: int, rng: np.random.Generator) -> Case:
    scanner = StereoScanner(spacing_mm=(2.0, 3.5), noise_mm=(0.05, 0.5), stray=(0.001, 0.01), pieces=(1, 5))
    return _sized(face_case(*stereo_scan(seed, features=(), scanner=scanner)), rng)


def _light_stage_person(seed: int, rng: np.random.Generator) -> Case:
    return _sized(light_stage_person(seed - UNSEEN), rng)


def _hard_light_stage_person(seed: int, rng: np.random.Generator) -> Case:
    return _sized(light_stage_person(seed - UNSEEN, HARD), rng)


def _scrap(seed: int, rng: np.random.Generator) -> Case:
    return scrap(seed - UNSEEN)


def _object(make: Callable[[np.random.Generator], tuple[FloatArray, np.ndarray]]) -> Callable[..., Case]:
    def made(seed: int, rng: np.random.Generator) -> Case:
        vertices, faces = make(rng)
        vertices = np.asarray(vertices, float) * rng.uniform(0.8, 1.25)
        noise = rng.normal(scale=rng.uniform(0, 2), size=(len(vertices), 1))
        vertices = vertices + noise * vertex_normals(vertices, np.asarray(faces))
        pose = compose(random_rotation(rng), rng.uniform(-300, 300, 3))
        return Case(RawScan(transform_points(pose, vertices), np.asarray(faces), name="object"), ())

    return made


def _solids(rng: np.random.Generator) -> tuple[FloatArray, np.ndarray]:
    """Return one to seven boxes, cylinders, capsules and balls in a heap."""
    meshes = []
    for _ in range(rng.integers(1, 8)):
        size = rng.uniform(15, 120, 3)
        makers = (
            lambda size: trimesh.creation.box(size),
            lambda size: trimesh.creation.cylinder(size[0] / 2, size[1]),
            lambda size: trimesh.creation.capsule(size[0], size[1] / 3),
            lambda size: trimesh.creation.icosphere(3, size[0] / 2),
        )
        mesh = makers[rng.integers(len(makers))](size).subdivide_to_size(12)
        mesh.apply_transform(compose(random_rotation(rng), rng.normal(scale=45, size=3)))
        meshes.append(mesh)
    heap = trimesh.util.concatenate(meshes)
    return np.array(heap.vertices), np.array(heap.faces, np.int64)


def _waves(rng: np.random.Generator) -> tuple[FloatArray, np.ndarray]:
    """Return a random relief, one in three of them symmetric."""
    vertices, faces = random_relief(rng)
    if rng.uniform() < 0.33:
        size = int(np.sqrt(len(vertices)))
        z = vertices[:, 2].reshape(size, size)
        vertices[:, 2] = ((z + z[:, ::-1]) / 1.4).ravel()
    return vertices, faces


def _grating(rng: np.random.Generator) -> tuple[FloatArray, np.ndarray]:
    """Return a sheet with regular waves, bumps or ridges, whose hollows repeat as eyes and mouths do."""
    vertices, faces = random_relief(rng)
    x, y = vertices[:, :2].T
    lengths, phases, heights = rng.uniform(8, 30, 2), rng.uniform(0, 2 * np.pi, 2), rng.uniform(2, 12, 2)
    bulge = rng.uniform(0, 60) * np.exp(-(x**2 + y**2) / rng.uniform(4000, 20000))
    vertices[:, 2] = bulge + heights @ np.sin(np.stack([x, y]) / lengths[:, None] + phases[:, None])
    return vertices, faces


KINDS: dict[str, Callable[[int, np.random.Generator], Case]] = {
    "person": _person,
    "hard person": _hard_person,
    "clean person": _clean_person,
    "light stage": _light_stage_person,
    "hard light stage": _hard_light_stage_person,
    "scrap": _scrap,
    "relief": _object(_waves),
    "body": _object(random_body),
    "solids": _object(_solids),
    "grating": _object(_grating),
}


@cache
def _template() -> Template:
    return Template.of(AnnotatedFaceModel.default(), 0)


def rows_of(task: tuple[str, int]) -> list[Row]:
    """Draw a scan and judge the best of its poses."""
    kind, seed = task
    case = KINDS[kind](seed, np.random.default_rng([seed, 61]))
    options, meter = RegistrationOptions(), Meter("icp", "mm", Budget.of(None), None)
    try:
        prepared = prepared_scan(case.scan, options)
    except RegistrationError:
        return []
    poses = coarse_poses(prepared, _template(), options, meter, 0)
    rows = []
    scorer = cache(lambda: colour_scorer(case.scan, AnnotatedFaceModel.default()))
    for candidate in ranked_candidates(prepared, _template(), scorer, None, poses, options, meter):
        if candidate.evidence is not None:
            pose = invert_rigid(candidate.pose.rigid(_template().front)) @ prepared.prepared_from_scan
            cues = tuple(candidate.evidence.cues[name] for name in SIGNS)
            rows.append(Row(kind, seed, cues, _is_right(pose, case)))
    return rows


def _is_right(pose: FloatArray, case: Case) -> bool | None:
    if case.model_from_scan is None or case.landmarks is None:
        return False
    change = pose @ invert_rigid(case.model_from_scan)
    degrees = np.degrees(rotation_angle_rad(change[:3, :3]))
    mm = np.linalg.norm(transform_points(change, case.landmarks) - case.landmarks, axis=1).mean()
    if degrees < RIGHT_DEG and mm < RIGHT_MM:
        return True
    return None if degrees < NEARLY_DEG and mm < NEARLY_MM else False


def fitted(cues: FloatArray, right: BoolArray, weights: FloatArray) -> tuple[FloatArray, float]:
    """Return the weights (K,) of the cues (N, K), with the signs given, and the intercept."""
    mean, deviation = cues.mean(0), cues.std(0) + 1e-12
    design = np.column_stack([(cues - mean) / deviation, np.ones(len(cues))])
    toward = np.where(right, -1.0, 1.0)

    def loss(x: FloatArray) -> tuple[float, FloatArray]:
        odds = toward * (design @ x)
        slope = weights * toward / (1 + np.exp(-odds))
        ridge = RIDGE * np.append(x[:-1], 0)
        value = weights @ np.logaddexp(0, odds) / weights.sum() + x @ ridge / 2
        return float(value), design.T @ slope / weights.sum() + ridge

    bounds = [(0, None) if sign > 0 else (None, 0) for sign in SIGNS.values()] + [(None, None)]
    x = minimize(loss, np.zeros(design.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x
    return x[:-1] / deviation, float(x[-1] - mean @ (x[:-1] / deviation))


def by_scan(odds: FloatArray, right: BoolArray, scans: list[tuple[str, int]]) -> tuple[float, float]:
    """Return slope and shift by which log odds (N,) of poses become those of scans' best poses [1]_.

    Poses of one scan are alike, so that odds fitted to poses are too modest. As many scans show a face as
    not: those with a right best pose weigh as much, together, as the others.

    .. [1] J. Platt, "Probabilistic outputs for support vector machines", 1999.
    """
    best: dict[tuple[str, int], int] = {}
    for number, scan in enumerate(scans):
        if scan not in best or odds[number] > odds[best[scan]]:
            best[scan] = number
    chosen = np.array(list(best.values()))
    odds, right = odds[chosen], right[chosen]
    weights = np.where(right, 1 / max(right.sum(), 1), 1 / max((~right).sum(), 1))

    def loss(x: FloatArray) -> float:
        return float(weights @ np.logaddexp(0, np.where(right, -1, 1) * (x[0] * odds + x[1])))

    slope, shift = minimize(loss, np.array([1.0, 0.0]), method="Nelder-Mead").x
    return float(slope), float(shift)


def _print_fit(rows: list[Row]) -> None:
    known = [row for row in rows if row.right is not None]
    cues, right = np.array([row.cues for row in known]), np.array([row.right for row in known], bool)
    seed, kind = np.array([row.seed for row in known]), np.array([row.kind for row in known])
    has_right = {(row.kind, row.seed) for row in known if row.right}
    beside = np.array([not row.right and (row.kind, row.seed) in has_right for row in known])
    weights = np.where(beside, WRONG_POSE_WEIGHT, np.where(kind == "scrap", SCRAP_WEIGHT, 1.0))
    odds = np.zeros(len(known))
    for half in (0, 1):
        taken = seed % 2 != half
        slopes, intercept = fitted(cues[taken], right[taken], weights[taken])
        odds[~taken] = cues[~taken] @ slopes + intercept
    slopes, intercept = fitted(cues, right, weights)
    print(f"{len(known)} poses of {len({(r.kind, r.seed) for r in known})} scans; log odds of halves unseen:")
    for name in KINDS:
        for label, chosen in (("right", right), ("wrong", ~right)):
            values = odds[chosen & (kind == name)]
            if len(values):
                low, middle, high = np.percentile(values, [1, 50, 99])
                print(f"  {name:18}{label:8}{len(values):6}{low:8.1f}{middle:8.1f}{high:8.1f}")
    false = np.logaddexp(0, np.where(right, -odds, odds))
    missed, let_in = np.mean(odds[right] < 0), np.mean(odds[~right] > 0)
    print(f"mean loss {weights @ false / weights.sum():.4f}; missed {missed:.1%}, let in {let_in:.2%}")
    # From halves unseen: odds of the cues that were fitted are too sure.
    growth, shift = by_scan(odds, right, [(row.kind, row.seed) for row in known])
    print(f"of scans: {growth:.2f} times the log odds of poses, and {shift:.2f} more")
    print(f"intercept {growth * intercept + shift:.2f}")
    print({name: round(growth * float(slope), 2) for name, slope in zip(SIGNS, slopes, strict=True)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scans", type=int, default=200, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="NPZ to write the cues into")
    arguments = parser.parse_args()
    tasks = [
        (kind, seed) for seed in range(arguments.first, arguments.first + arguments.scans) for kind in KINDS
    ]
    with ProcessPoolExecutor(arguments.jobs) as processes:
        rows = [row for found in processes.map(rows_of, tasks, chunksize=8) for row in found]
    if arguments.keep:
        np.savez(
            arguments.keep,
            cues=np.array([row.cues for row in rows]),
            right=np.array([np.nan if row.right is None else row.right for row in rows]),
            kind=np.array([row.kind for row in rows]),
            seed=np.array([row.seed for row in rows]),
        )
    _print_fit(rows)


if __name__ == "__main__":
    main()
