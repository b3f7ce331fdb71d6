"""Landmarks of fits beside those placed by hand: error by feature, and what the stated deviation is worth.

    OMP_NUM_THREADS=1 python tools/bench_landmarks.py [--expressions] [--given] [--json FILE]
    OMP_NUM_THREADS=1 python tools/bench_landmarks.py --mouths
    OMP_NUM_THREADS=1 python tools/bench_landmarks.py --lamps
    OMP_NUM_THREADS=1 python tools/bench_landmarks.py --glasses

"james" and "flame_scan" are real scans with points placed by hand, "traced" path-traced whole heads,
the others light-stage shapes made raw, with `--expressions` each of twelve at weights .6 and 1. Every scan is
registered and fitted with the default model, without any help; with `--given` also with five landmarks, and
with one of them 25 mm off. "james, colours left out" is fitted by shape alone; "auto" are real and
path-traced scans with the landmarks that MediaPipe finds (where the extra [landmarks] is installed),
"MediaPipe" these landmarks themselves, those it has. Errors are mean distances in mm over the 51 inner points
of iBUG-68. The last lines show how many coordinates lie within one and two of their stated
standard deviations: 68 % and 95 % where it is right. `--mouths` counts instead, of 200 scans of shut mouths
with many expressions and of open jaws, how many jaws were judged rightly. `--lamps` paints shapes in one
colour under a lamp, and shows by how much landmarks get worse when colours are looked at. `--glasses` puts
glasses with lenses on them, and shows the errors of surface and landmarks around the eyes. Needs
../shared/data.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from itertools import count
from pathlib import Path

import numpy as np
from benchmarks.door_scans import PLACED, WRONG_BY_MM
from benchmarks.scan_files import DATA, face_data

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.landmarks import PLACED_SIGMA_MM, PlacedLandmarks
from scan2albedo.errors import NoFaceError
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.openings import EYES
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.nearest_surface import NearestSurface
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.pipeline.detected_landmarks import detected_landmarks
from scan2albedo.synthetic import raw_like, raw_scan
from scan2albedo.synthetic.head import join
from scan2albedo.synthetic.wearer import worn_glasses

FEATURES = {
    "brows": range(17, 27),
    "bridge": range(27, 31),
    "nostrils": range(31, 36),
    "eyes": range(36, 48),
    "lips": range(48, 68),
}
INNER = slice(17, 68)
SHAPE_ALONE = ", colours left out"
KEY_POINTS = (51, 39, 42, 48, 54)
"""The five that autofacemonker has, too."""
SHUT = ("cheek_puff", "mouth_frown", "mouth_pucker", "mouth_roll_lower", "mouth_roll_upper", "mouth_upper_up")
"""Expressions that leave the jaw shut; lips may part by some mm."""
OWN_SHUT = ("neutral", "smile", "frown", "pout", "puff")
NEUTRAL = ("generic_neutral", "person1", "person2", "person3", "person4")
WEIGHTS = (0.6, 1.0)
LAMPS_DEG = ((0, 0), (0, 50), (0, 70), (0, 90), (0, -50), (50, 30), (-60, 0), (30, -40))
"""Directions of lamps: to the left of the face's front, and above it."""
LENS_MM = 13.0
"""Between lids and lenses, as tight sunglasses stand; a fit follows no lens from 15 mm on."""
SKIN, AMBIENT = (0.8, 0.55, 0.45), 0.08


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
    with np.load(face_data("ict_faces.npz")) as data:
        shapes = {name: data[f"shape_{name}"].astype(float) for name in NEUTRAL}
        faces, at = data["faces"].astype(np.int64), data["landmarks68"].astype(np.int64)

    def case(group: str, name: str, shape: FloatArray, seed: int) -> Case:
        scan, scan_from_shape = raw_like(shape, faces, seed)
        return Case(group, name, scan, transform_points(scan_from_shape, shape[at]))

    for seed, (name, shape) in enumerate(shapes.items()):
        yield case("neutral", name, shape, seed)
    if not expressions:
        return
    with np.load(face_data("ict_expressions.npz")) as data:
        moves = {name: data[name].astype(float) for name in sorted(data)}
    for seed, (name, move) in enumerate(moves.items()):
        person, shape = list(shapes.items())[seed % len(shapes)]
        for weight in WEIGHTS:
            yield case(name, f"{person} {weight}", shape + weight * move, 100 + seed)


def mouths() -> Iterator[tuple[str, s2a.RawScan, bool]]:
    """Yield names, scans, and whether the jaw is open."""
    with np.load(face_data("ict_faces.npz")) as data:
        shapes = {name: data[f"shape_{name}"].astype(float) for name in NEUTRAL}
        faces = data["faces"].astype(np.int64)
    with np.load(face_data("ict_expressions.npz")) as data:
        moves = {name: data[name].astype(float) for name in (*SHUT, "jaw_open")}
    seeds = count(2000)
    for person, shape in shapes.items():
        for _ in range(2):
            yield f"neutral {person}", raw_like(shape, faces, next(seeds))[0], False
        for name, weight in ((name, weight) for name in moves for weight in (0.5, 0.75, 1.0)):
            scan, _ = raw_like(shape + weight * moves[name], faces, next(seeds))
            yield f"{name} {person} {weight}", scan, name == "jaw_open"
        for weight in (0.4, 0.6, 0.8, 0.9, 1.1):
            scan, _ = raw_like(shape + weight * moves["jaw_open"], faces, next(seeds))
            yield f"jaw_open {person} {weight}", scan, True
    for name, seed in ((name, seed) for name in OWN_SHUT for seed in range(12)):
        yield f"own {name} {seed}", raw_scan(100 + seed, expression=name)[0], False


def print_mouths(model: s2a.AnnotatedFaceModel) -> None:
    """Print the jaws that were judged wrongly, and how many rightly."""
    right: dict[bool, list[bool]] = {True: [], False: []}
    for name, scan, is_open in mouths():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            angle = s2a.fit(scan, model, s2a.register(scan, model)).metrics["jaw_deg"]
        right[is_open].append((angle > 0) == is_open)
        if not right[is_open][-1]:
            print(f"{name}: jaw turned by {angle:.0f} degrees")
    for is_open, each in right.items():
        print(f"{'open' if is_open else 'shut'} jaws: {sum(each)} of {len(each)} judged rightly")


def print_lamps(model: s2a.AnnotatedFaceModel) -> None:
    """Print by how much the landmarks of shapes of one colour get worse under lamps."""
    worse = []
    for case in (c for c in cases(expressions=False) if c.group in ("flame_scan", "neutral")):
        pose = s2a.register(case.scan, model).model_from_scan
        normals = vertex_normals(case.scan.vertices, case.scan.faces) @ pose[:3, :3].T
        plain = fitted_row(case, model, pose).error_mm[INNER]
        parts = []
        for beside, above in np.deg2rad(LAMPS_DEG):
            toward = [np.sin(beside) * np.cos(above), np.sin(above), np.cos(beside) * np.cos(above)]
            light = AMBIENT + np.maximum(normals @ toward, 0)
            lit = replace(case.scan, vertex_color_linear=light[:, None] * SKIN)
            row = fitted_row(replace(case, scan=lit), model, pose)
            worse.append(float(np.nanmean(row.error_mm[INNER] - plain)))
            parts.append(f"{worse[-1]:+8.2f}")
        print(f"{case.name:28}" + "".join(parts))
    print(f"mean {np.mean(worse):+.2f}, worst {np.max(worse):+.2f} mm")


def print_glasses(model: s2a.AnnotatedFaceModel) -> None:
    """Print the errors around the eyes, mm, of shapes without and with glasses, covers kept and left out."""
    with np.load(face_data("ict_faces.npz")) as data:
        shapes = {name: data[f"shape_{name}"].astype(float) for name in NEUTRAL}
        faces, at = data["faces"].astype(np.int64), data["landmarks68"].astype(np.int64)
    print(f"{'':28}{'surface by the eyes':>20}{'elsewhere':>12}{'eyes':>8}{'all 51':>8}")
    found: dict[str, list[list[float]]] = {}
    for seed, (name, shape) in enumerate(shapes.items()):
        eyes = shape[at[36:48]].mean(0)
        dressed = join([(shape, faces), worn_glasses((shape, faces), eyes, seed, LENS_MM)])
        for label, mesh, covers in (
            ("bare", (shape, faces), True),
            ("glasses, followed", dressed, False),
            ("glasses", dressed, True),
        ):
            scan, scan_from_shape = raw_like(*mesh, seed)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    pose = s2a.register(scan, model)
                except NoFaceError as error:
                    print(f"{label} {name}: refused with {error.confidence:.2f}")
                    continue
                fitted = s2a.fit(scan, model, pose, options=FitOptions(covers=covers))
            shape_from_model = np.linalg.inv(fitted.model_from_scan @ scan_from_shape)
            points = transform_points(shape_from_model, fitted.vertices)
            distance = NearestSurface(shape, faces).query(points).distance
            middles = [shape[at[list(eye)]].mean(0) for eye in EYES]
            by_eyes = np.min([np.linalg.norm((points - eye)[:, :2], axis=1) for eye in middles], axis=0) < 28
            landmarks = transform_points(shape_from_model, fitted.landmarks)
            off = np.linalg.norm(landmarks - shape[at], axis=1)
            row = [distance[by_eyes].mean(), distance[~by_eyes].mean(), off[36:48].mean(), off[INNER].mean()]
            found.setdefault(label, []).append(row)
            print(glasses_line(f"{label} {name}", row))
    print()
    for label, rows in found.items():
        print(glasses_line(label, np.mean(rows, axis=0).tolist()))


def glasses_line(label: str, row: list[float]) -> str:
    return f"{label:28}{row[0]:20.2f}{row[1]:12.2f}{row[2]:8.2f}{row[3]:8.2f}"


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


def detected(case: Case, model: s2a.AnnotatedFaceModel) -> Row:
    """Return the error of the landmarks that MediaPipe finds on a registered scan, NaN where it has none."""
    registration = s2a.register(case.scan, model)
    begin = time.process_time()
    found = detected_landmarks(case.scan, registration.model_from_scan)
    cpu_s = time.process_time() - begin
    points = np.full((68, 3), np.nan) if found is None else found.points
    sigma_mm = np.full(68, np.nan) if found is None else found.sigma_mm
    return Row(f"MediaPipe, {case.group}", case.name, points - case.landmarks, sigma_mm, cpu_s)


def with_detected(case: Case, model: s2a.AnnotatedFaceModel) -> Case:
    """Return the case with the landmarks that MediaPipe finds."""
    found = detected_landmarks(case.scan, s2a.register(case.scan, model).model_from_scan)
    return replace(case, group=f"auto, {case.group}", scan=replace(case.scan, landmarks=found))


def with_five(case: Case, *, one_wrong: bool) -> Case:
    """Return the case with five landmarks given, placed to 1.5 mm along each axis; the last may be wrong."""
    points, five = np.full((68, 3), np.nan), list(PLACED)
    noise = np.random.default_rng(5).normal(scale=PLACED_SIGMA_MM, size=(len(five), 3))
    points[five] = case.landmarks[five] + noise
    points[five[-1]] += WRONG_BY_MM if one_wrong else 0.0
    scan = replace(case.scan, landmarks=PlacedLandmarks.of(points))
    return replace(case, group=f"{'4 of 5' if one_wrong else '5'} given, {case.group}", scan=scan)


def line(label: str, rows: list[Row]) -> str:
    """Return the mean error of 51 points and of each feature, the largest and the CPU seconds of rows."""
    error = np.stack([row.error_mm for row in rows])
    parts = "".join(f"{np.nanmean(error[:, list(points)]):10.2f}" for points in FEATURES.values())
    seconds = np.mean([row.cpu_s for row in rows])
    return (
        f"{label:28}{np.nanmean(error[:, INNER]):8.2f}{parts}{np.nanmax(error[:, INNER]):10.1f}{seconds:8.1f}"
    )


def print_deviations(rows: list[Row]) -> None:
    """Print by feature the stated deviations, the real ones, and the coordinates within one and two."""
    offset = np.stack([row.offset_mm for row in rows])
    stated = np.stack([row.deviation_mm for row in rows])[..., None]
    print(f"\n{'deviation along an axis, mm':28}{'stated':>8}{'real':>8}{'within 1':>10}{'within 2':>10}")
    for name, points in (("jaw line", range(17)), *FEATURES.items(), ("all 51", range(17, 68))):
        here = np.abs(offset[:, list(points)])
        ratio = here / stated[:, list(points)]
        real = np.sqrt(np.nanmean(here**2))
        print(
            f"{name:28}{stated[:, list(points)].mean():8.2f}{real:8.2f}"
            f"{np.nanmean(ratio < 1):10.0%}{np.nanmean(ratio < 2):10.0%}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--expressions", action="store_true", help="also twelve expressions at two weights")
    parser.add_argument(
        "--given", action="store_true", help="also with five landmarks given, one of them wrong"
    )
    parser.add_argument("--mouths", action="store_true", help="judge 200 jaws instead")
    parser.add_argument("--lamps", action="store_true", help="light shapes of one colour instead")
    parser.add_argument("--glasses", action="store_true", help="put glasses on shapes instead")
    parser.add_argument("--json", type=Path, help="file for all offsets")
    arguments = parser.parse_args()
    model = s2a.AnnotatedFaceModel.default()
    if arguments.mouths:
        print_mouths(model)
        return
    if arguments.lamps:
        print_lamps(model)
        return
    if arguments.glasses:
        print_glasses(model)
        return
    s2a.register(s2a.load_scan(face_data("humface.ply")), model)  # compiles
    print(f"{'':28}{'51':>8}" + "".join(f"{name:>10}" for name in (*FEATURES, "largest")) + f"{'CPU s':>8}")
    rows = []
    every = list(cases(expressions=arguments.expressions))
    if arguments.given:
        every += [with_five(case, one_wrong=wrong) for wrong in (False, True) for case in every]
    for case in every:
        rows.append(measured(case, model))
        print(line(f"{case.group} {case.name}" if case.group != case.name else case.name, rows[-1:]))
    if find_spec("mediapipe") is not None:
        seen = [case for case in every if case.group in ("james", "flame_scan", "traced")]
        for case in seen:
            rows += [detected(case, model), measured(with_detected(case, model), model)]
            print(line(f"MediaPipe {case.name}", rows[-2:-1]))
            print(line(f"auto {case.name}", rows[-1:]))
    print()
    for group in dict.fromkeys(row.group for row in rows):
        print(line(group, [row for row in rows if row.group == group]))
    james = next(row for row in rows if row.group == "james")
    print(f"james, five key points: {james.error_mm[list(KEY_POINTS)].mean():.2f} mm")
    helped = ("given", SHAPE_ALONE, "MediaPipe", "auto")
    print_deviations([row for row in rows if not any(word in row.group for word in helped)])
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(r) for r in rows], default=np.ndarray.tolist))


if __name__ == "__main__":
    main()
