"""Landmarks of fits beside those placed by hand: error by feature, and what the stated deviation is worth.

    OMP_NUM_THREADS=1 python tools/bench_landmarks.py [--expressions] [--given] [--peers-python PYTHON]
        [--json FILE]
    OMP_NUM_THREADS=1 python tools/bench_landmarks.py --mouths
    OMP_NUM_THREADS=1 python tools/bench_landmarks.py --lamps
    OMP_NUM_THREADS=1 python tools/bench_landmarks.py --glasses

"james" and "flame_scan" are real scans with points placed by hand, "traced" path-traced whole heads,
the others light-stage shapes made raw, with `--expressions` each of twelve at weights .6 and 1. Every scan is
registered and fitted with the default model, without any help; with `--given` also with five landmarks, and
with one of them 25 mm off. "james, colours left out" is fitted by shape alone; "auto" are real and
path-traced scans with the landmarks that MediaPipe finds (where the extra [landmarks] is installed),
"MediaPipe" these landmarks themselves, those it has. `--peers-python` names a Python that has the peers of
`bench_fit.py`: "nricp_amberg" deforms the default model from the pose that ours has found, but not on
expressions, "autofacemonker" finds five points on scans with texture. Errors are mean distances in mm over
the 51 inner points of iBUG-68. The last lines show how many coordinates lie within one and two of their
stated standard deviations: 68 % and 95 % where it is right; before them the landmarks that those who placed
them put at the most different heights. `--mouths` counts instead, of 200 scans of shut
mouths with many expressions and of open jaws, how many jaws were judged rightly. `--lamps` paints shapes in
one colour under a lamp, and shows by how much landmarks get worse when colours are looked at. `--glasses`
puts glasses with lenses on them, and shows the errors of surface and landmarks around the eyes. Needs
../shared/data.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path

import bench_fit
import numpy as np
from benchmarks.landmark_cases import INNER, SHAPE_ALONE, Case, Row, cases, measured
from benchmarks.landmark_trials import print_glasses, print_lamps, print_mouths
from worlds.door import PLACED, WRONG_BY_MM
from worlds.files import DATA, face_data

import scan2albedo as s2a
from scan2albedo.core.landmarks import PLACED_SIGMA_MM, PlacedLandmarks
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.pipeline.detected_landmarks import detected_landmarks

FEATURES = {
    "brows": range(17, 27),
    "bridge": range(27, 31),
    "nostrils": range(31, 36),
    "eyes": range(36, 48),
    "lips": range(48, 68),
}
KEY_POINTS = (51, 39, 42, 48, 54)
"""The five that autofacemonker has, too."""


def detected(case: Case, model: s2a.AnnotatedFaceModel) -> Row:
    """Return the error of the landmarks that MediaPipe finds on a registered scan, NaN where it has none."""
    registration = s2a.register(case.scan, model)
    begin = time.process_time()
    found = detected_landmarks(case.scan, registration.model_from_scan)
    cpu_s = time.process_time() - begin
    points = np.full((68, 3), np.nan) if found is None else found.points
    sigma_mm = np.full(68, np.nan) if found is None else found.sigma_mm
    return Row(f"MediaPipe, {case.group}", case.name, points - case.landmarks, sigma_mm, cpu_s)


def deformed_by_nricp(case: Case, model: s2a.AnnotatedFaceModel, python: str, folder: Path) -> Row | None:
    """Deform the model by trimesh's `nricp_amberg` from our pose; None where the peer is not installed."""
    registration = s2a.register(case.scan, model)
    posed = bench_fit.Case(case.name, case.scan, model, registration.model_from_scan, np.empty((0, 3)))
    rest, faces = model.surface(1)
    found = bench_fit.deformed_by("nricp_amberg", posed, python, folder)
    if found is None or model.landmarks is None:
        return None
    hits = ClosestPointQuery(rest, faces).query(model.landmarks)
    vertices, cpu_s = found
    landmarks = np.einsum("nk,nkj->nj", hits.barycentric, vertices[faces[hits.face]])
    offset = landmarks - transform_points(registration.model_from_scan, case.landmarks)
    return Row(f"nricp_amberg, {case.group}", case.name, offset, np.full(68, np.nan), cpu_s)


def found_by_autofacemonker(case: Case, python: str, folder: Path) -> Row | None:
    """Return the errors of its five key points on a scan with texture; None where it fails."""
    file = face_data("james.obj") if case.name == "james" else str(DATA / "traced" / f"{case.name}.obj")
    if not bench_fit.run_peer(python, "autofacemonker", file, folder / "peer.npz"):
        return None
    peer = np.load(folder / "peer.npz")
    number = {int(k): int(v) for k, v in peer["key_points"]}
    offset = np.full((68, 3), np.nan)
    unit_mm = case.scan.mm_per_unit or 1.0
    for theirs, ours in bench_fit.KEY_POINTS.items():
        offset[ours] = unit_mm * peer["vertices"][number[theirs]] - case.landmarks[ours]
    return Row(f"autofacemonker, {case.group}", case.name, offset, np.full(68, np.nan), float(peer["cpu_s"]))


def with_detected(case: Case, model: s2a.AnnotatedFaceModel) -> Case:
    """Return the case with the landmarks that MediaPipe finds."""
    found = detected_landmarks(case.scan, s2a.register(case.scan, model).model_from_scan)
    return replace(case, group=f"auto, {case.group}", scan=replace(case.scan, landmarks=found))


def peers(every: list[Case], model: s2a.AnnotatedFaceModel, python: str) -> Iterator[Row]:
    """Yield the rows of peers, and print them."""
    with tempfile.TemporaryDirectory() as name:
        for case in every:
            row = None
            if case.group in ("james", "flame_scan", "traced", "neutral"):
                row = deformed_by_nricp(case, model, python, Path(name))
            found = [row] if row else []
            if case.group in ("james", "traced"):
                row = found_by_autofacemonker(case, python, Path(name))
                found += [row] if row else []
            for row in found:
                print(line(f"{row.group} {row.name}", [row]), flush=True)
                yield row


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of features without a landmark
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


def print_definitions(groups: dict[str, list[Row]]) -> None:
    """Print where whoever placed landmarks puts some higher or lower than another one does, by the model's.

    No model's landmarks are nearer to all of them than half of what they lie apart.
    """
    names = [name for name in ("james", "flame_scan", "neutral") if name in groups]
    above = -np.array([np.mean([row.offset_mm[:, 1] for row in groups[name]], axis=0) for name in names])
    print(f"\n{'above the model, mm':28}" + "".join(f"{name:>12}" for name in names) + f"{'apart':>8}")
    for number in np.argsort(-np.ptp(above, axis=0))[: len(FEATURES)]:
        heights = "".join(f"{height:12.1f}" for height in above[:, number])
        print(f"landmark {number:<19}{heights}{np.ptp(above[:, number]):8.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--expressions", action="store_true", help="also twelve expressions at two weights")
    parser.add_argument(
        "--given", action="store_true", help="also with five landmarks given, one of them wrong"
    )
    parser.add_argument("--mouths", action="store_true", help="judge 200 jaws instead")
    parser.add_argument("--lamps", action="store_true", help="light shapes of one colour instead")
    parser.add_argument("--glasses", action="store_true", help="put glasses on shapes instead")
    parser.add_argument("--peers-python", help="Python of an environment with the peers")
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
    if arguments.peers_python:
        rows += list(peers(every, model, arguments.peers_python))
    print()
    groups = {
        group: [row for row in rows if row.group == group] for group in dict.fromkeys(r.group for r in rows)
    }
    for group, here in groups.items():
        print(line(group, here))
    print(f"\n{'five key points, mm':28}")
    for group, here in groups.items():
        print(f"{group:28}{np.mean([row.error_mm[list(KEY_POINTS)].mean() for row in here]):8.2f}")
    print_definitions(groups)
    helped = ("given", SHAPE_ALONE, "MediaPipe", "auto", "nricp_amberg")
    print_deviations([row for row in rows if not any(word in row.group for word in helped)])
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(r) for r in rows], default=np.ndarray.tolist))


if __name__ == "__main__":
    main()
