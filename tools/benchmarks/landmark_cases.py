"""Scans with known landmarks, and the offsets of those that a fit finds, for `bench_landmarks.py`."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from worlds.files import DATA, face_data
from worlds.raw_like import raw_like

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.fitting import FitOptions
from scan2albedo.geometry.rigid import transform_points

SHAPE_ALONE = ", colours left out"
INNER = slice(17, 68)
"""iBUG-68 numbers of brows, nose, eyes and lips."""
NEUTRAL = ("generic_neutral", "person1", "person2", "person3", "person4")
WEIGHTS = (0.6, 1.0)


@dataclass(frozen=True)
class LightStage:
    """Whole heads `shapes` (V, 3) by name, their `faces` (F, 3), and the vertices of 68 landmarks."""

    shapes: dict[str, FloatArray]
    faces: IntArray
    landmarks: IntArray

    @classmethod
    def load(cls) -> LightStage:
        """Read five people without expression."""
        with np.load(face_data("ict_faces.npz")) as data:
            shapes = {name: data[f"shape_{name}"].astype(float) for name in NEUTRAL}
            return cls(shapes, data["faces"].astype(np.int64), data["landmarks68"].astype(np.int64))


def expressions_of_light_stage() -> dict[str, FloatArray]:
    """Return displacements (V, 3) by name."""
    with np.load(face_data("ict_expressions.npz")) as data:
        return {name: data[name].astype(float) for name in sorted(data)}


@dataclass(frozen=True)
class Case:
    """A scan and its landmarks (68, 3) in mm in the scan's frame, NaN where nobody placed one."""

    group: str
    name: str
    scan: s2a.RawScan
    landmarks: FloatArray


@dataclass(frozen=True)
class Row:
    """Offsets of the landmarks found from those placed (68, 3), and stated deviations (68,), mm."""

    group: str
    name: str
    offset_mm: FloatArray
    deviation_mm: FloatArray
    cpu_s: float

    @property
    def error_mm(self) -> FloatArray:
        """(68,)"""
        return np.linalg.norm(self.offset_mm, axis=1)


def cases(*, expressions: bool) -> Iterator[Case]:
    given = np.loadtxt(face_data("james_ibug68.csv"), delimiter=",")
    james = s2a.load_scan(face_data("james.obj"))
    yield Case("james", "james", james, given)
    yield Case(f"james{SHAPE_ALONE}", "james", james, given)
    inner = 1000 * np.loadtxt(face_data("flame_scan_ibug51.csv"), delimiter=",")
    given = np.concatenate([np.full((17, 3), np.nan), inner])
    yield Case("flame_scan", "flame_scan", s2a.load_scan(face_data("flame_scan.obj")), given)
    for file in sorted((DATA / "traced").glob("p*_truth.npz")):
        name = file.stem.removesuffix("_truth")
        with np.load(file) as truth:
            placed = truth["vertices_mm"][truth["landmarks68"]]
            given = transform_points(truth["scan_from_truth"], placed) * float(truth["unit_mm"])
        yield Case("traced", name, s2a.load_scan(file.with_name(f"{name}.obj")), given)
    yield from _light_stage(expressions=expressions)


def _light_stage(*, expressions: bool) -> Iterator[Case]:
    people = LightStage.load()

    def case(group: str, name: str, shape: FloatArray, seed: int) -> Case:
        scan, scan_from_shape = raw_like(shape, people.faces, seed)
        return Case(group, name, scan, transform_points(scan_from_shape, shape[people.landmarks]))

    for seed, (name, shape) in enumerate(people.shapes.items()):
        yield case("neutral", name, shape, seed)
    if not expressions:
        return
    for seed, (name, move) in enumerate(expressions_of_light_stage().items()):
        person, shape = list(people.shapes.items())[seed % len(people.shapes)]
        for weight in WEIGHTS:
            yield case(name, f"{person} {weight}", shape + weight * move, 100 + seed)


def measured(case: Case, model: s2a.AnnotatedFaceModel) -> Row:
    """Register and fit a scan, and compare its landmarks in the model's frame."""
    begin = time.process_time()
    registration = s2a.register(case.scan, model)
    row = fitted_row(case, model, registration.model_from_scan)
    return replace(row, cpu_s=time.process_time() - begin)


def fitted_row(case: Case, model: s2a.AnnotatedFaceModel, pose: FloatArray) -> Row:
    """Fit a scan from its pose, and compare its landmarks in the model's frame."""
    begin = time.process_time()
    options = FitOptions(colors=SHAPE_ALONE not in case.group)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = s2a.fit(case.scan, model, pose, options=options)
    cpu_s = time.process_time() - begin
    assert fitted.landmarks is not None
    assert fitted.landmark_deviation_mm is not None
    offset = fitted.landmarks - transform_points(fitted.model_from_scan, case.landmarks)
    return Row(case.group, case.name, offset, fitted.landmark_deviation_mm, cpu_s)
