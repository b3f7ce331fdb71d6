"""What the door lets in: faces in raw stereo, and everything else.

`faces` are random people as a stereo scanner sees them ("stereo"), mixtures of light-stage people and
expressions captured in the same way ("ict"), both with up to 6 mm of noise, more holes and less of the face
("hard"), and the hard ones with five landmarks, then with one of these 25 mm off. A pose is right within 10
degrees and 15 mm (mean over 68 landmarks) of the one that lays brows, nose and eyes on the model's; a refusal
counts as right for the confidence, or as the pose of its error is. `others` are captures that show no face
("scraps"), random reliefs and bodies ("reliefs", every tenth also without a known unit), and 43 things
("objects"): "let in" are those accepted with a confidence of 0.5 and more. `repeat` captures twenty shapes
ten times each: how far poses are from their mean, by registration and after the fit. None is one of the
first 100,000 seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from worlds.door import (
    UNSEEN,
    Case as DoorScan,
    hard_person,
    light_stage_person,
    own_person,
    relief,
    scrap,
    with_landmarks,
)
from worlds.light_stage import light_stage_head
from worlds.objects import wrong_object
from worlds.stereo import stereo_scan_of

from bench.runner import Bench, Case, Row
from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.fitting import fit
from scan2albedo.geometry.rigid import invert_rigid, rotation_angle_rad, transform_points
from scan2albedo.pipeline.scale_search import registered_at_any_scale
from scan2albedo.registration import register
from scan2albedo.synthetic.sitter import sit_down

BASIN_DEG = 10.0
BASIN_MM = 15.0
"""A pose within these of the truth is right: a fit finds the rest."""
UNSURE = 0.5
BINS = 10
"""Of confidence."""
LEAST_IN_BIN = 20
"""Scans of a bin whose gap counts."""
FACES: dict[str, tuple[Callable[[int], DoorScan], int]] = {
    "stereo": (own_person, 1000),
    "ict": (light_stage_person, 300),
    "hard": (hard_person, 400),
    "five landmarks": (lambda number: with_landmarks(hard_person(number), number), 60),
    "one of five wrong": (lambda number: with_landmarks(hard_person(number), number, one_wrong=True), 60),
}
"""What makes a scan, and how many there are."""
OTHERS: dict[str, tuple[Callable[[int], DoorScan], int]] = {
    "scraps": (scrap, 300),
    "reliefs": (relief, 200),
    "any unit": (relief, 20),
    "objects": (lambda number: DoorScan(wrong_object(number)[1], (wrong_object(number)[0],)), 43),
}
CAPTURES = 10
OWN: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("smile", ()),
    ("surprise", ("open mouth",)),
    ("neutral", ()),
    ("smile", ("open mouth",)),
    ("puff", ("glasses",)),
    ("frown", ("beard",)),
    ("pout", ("fringe",)),
    ("smile", ("glasses", "no neck")),
    ("surprise", ()),
    ("neutral", ("open mouth",)),
)
"""Expressions and features of own people that are captured again and again."""
LIGHT_STAGE: tuple[dict[str, float], ...] = (
    {"smile": 1.0},
    {"jaw_open": 0.7},
    {},
    {"smile": 0.6, "jaw_open": 0.4},
    {"cheek_puff": 0.8},
    {"jaw_open": 1.0},
    {"mouth_funnel": 0.9},
    {"smile": 1.0, "eye_blink": 1.0},
    {"brow_inner_up": 1.0, "jaw_open": 0.5},
    {"brow_down": 1.0, "nose_sneer": 0.8},
)
"""The same of light-stage people."""
NEAR_DEG = 1.0
NEAR_MM = 1.5


@dataclass(frozen=True)
class Answer:
    """A pose (4, 4) and a confidence, None where there is none; `message` where the scan was refused."""

    pose: FloatArray | None
    sure: float | None
    message: str = ""


def plainly(scan: RawScan) -> Answer:
    try:
        found = register(scan, AnnotatedFaceModel.default())
    except Scan2AlbedoError as error:
        # An error may say how sure it is, and of what pose.
        pose = getattr(error, "model_from_scan", None)
        return Answer(pose, getattr(error, "confidence", None), str(error))
    return Answer(found.model_from_scan, found.confidence)


def at_any_scale(scan: RawScan) -> Answer:
    model = AnnotatedFaceModel.default()
    try:
        _, found = registered_at_any_scale(scan, True, lambda scan: (scan, register(scan, model)))
    except Scan2AlbedoError as error:
        return Answer(None, None, str(error))
    return Answer(found.model_from_scan, found.confidence)


@dataclass(frozen=True)
class Scene:
    """A scan of a part, and how it is registered."""

    scan: DoorScan
    register: Callable[[RawScan], Answer] = plainly


def cases(parts: dict[str, tuple[Callable[[int], DoorScan], int]], quick: bool) -> Iterator[Case]:
    for part, (make, count) in parts.items():
        for number in range(2 if quick else count):
            how = at_any_scale if part == "any unit" else plainly
            yield Case(f"{part} {number}", lambda make=make, n=number, how=how: Scene(make(n), how), part)


def outcome(scan: DoorScan, answer: Answer) -> tuple[str, float, float]:
    """Return how a scan of a face ended, and the degrees and mm of its pose from the true one."""
    if answer.pose is None:
        return "refused", np.nan, np.nan
    change = answer.pose @ invert_rigid(scan.model_from_scan)
    degrees = float(np.degrees(rotation_angle_rad(change[:3, :3])))
    moved = transform_points(change, scan.landmarks) - scan.landmarks
    mm = float(np.linalg.norm(moved, axis=1).mean())
    if answer.message:
        return "refused", degrees, mm
    if degrees <= BASIN_DEG and mm <= BASIN_MM:
        return "right", degrees, mm
    return "wrong", degrees, mm


def judged_face(scene: Scene, answer: Answer) -> dict[str, float | str]:
    ended, degrees, mm = outcome(scene.scan, answer)
    within = np.isnan(degrees) or (degrees <= BASIN_DEG and mm <= BASIN_MM)
    sure = np.nan if answer.sure is None else answer.sure
    row: dict[str, float | str] = {
        "right %": 100.0 * (ended == "right"),
        "refused %": 100.0 * (ended == "refused"),
        "sure misses %": 100.0 * (ended == "wrong" and sure >= UNSURE),
        "confidence": sure,
        "pose right %": 100.0 * within,
    }
    if ended == "right":
        row |= {"deg": degrees, "mm": mm}
    else:
        row["ended"] = f"{ended} {answer.message} ({', '.join(scene.scan.kinds)})"
    return row


def judged_other(scene: Scene, answer: Answer) -> dict[str, float | str]:
    sure = answer.sure is None or answer.sure >= UNSURE
    let_in = not answer.message and sure
    row: dict[str, float | str] = {
        "refused %": 100.0 * bool(answer.message),
        "let in %": 100.0 * let_in,
        "confidence": np.nan if answer.sure is None else answer.sure,
    }
    return row | ({"kinds": ", ".join(scene.scan.kinds)} if let_in else {})


@dataclass(frozen=True)
class Reliability:
    """Scans of bins of confidence: their `count`, mean `confidence` and `share` of right poses (`BINS`,)."""

    count: FloatArray
    confidence: FloatArray
    share: FloatArray

    @classmethod
    def of(cls, sure: FloatArray, right: FloatArray) -> Reliability:
        """Return the bins of confidences (N,) and whether the poses were right (N,)."""
        index = np.minimum((sure * BINS).astype(int), BINS - 1)
        count = np.bincount(index, minlength=BINS).astype(float)
        most = np.maximum(count, 1)
        means = (np.bincount(index, values, BINS) / most for values in (sure, right))
        return cls(count, *means)

    @property
    def largest_gap(self) -> float:
        """Of the bins of `LEAST_IN_BIN` scans and more."""
        gaps = np.abs(self.confidence - self.share)[self.count >= LEAST_IN_BIN]
        return float(gaps.max(initial=0))

    @property
    def mean_gap(self) -> float:
        """Over all scans."""
        return float(np.average(np.abs(self.confidence - self.share), weights=self.count))


def reliability(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the bins of confidence beside the share that is right, of the scans whose answer has one."""
    known = [row.values for row in rows if not row.failed and np.isfinite(row.values["confidence"])]
    if not known:
        return
    found = Reliability.of(
        np.array([values["confidence"] for values in known]),
        np.array([values["pose right %"] / 100 for values in known]),
    )
    for k in range(BINS):
        figures = f"{found.count[k]:6.0f} scans, mean {found.confidence[k]:.2f}, right {found.share[k]:.2f}"
        yield f"confidence {k / BINS:.1f} to {(k + 1) / BINS:.1f}: {figures}"
    yield f"largest gap {found.largest_gap:.2f}, mean gap {found.mean_gap:.3f}"


@dataclass(frozen=True)
class Shape:
    """A person that is captured again and again, with landmarks (68, 3); `number` is its seed."""

    number: int
    vertices: FloatArray
    faces: IntArray
    landmarks: FloatArray
    features: tuple[str, ...] = ()


@cache
def own_shape(index: int) -> Shape:
    expression, features = OWN[index]
    sitter = sit_down(UNSEEN + 2 * index, expression=expression, model=AnnotatedFaceModel.default())
    return Shape(UNSEEN + 2 * index, sitter.vertices, sitter.faces, sitter.face.landmarks, features)


@cache
def light_stage_shape(index: int) -> Shape:
    number = UNSEEN + 2 * index + 1
    head = light_stage_head(np.random.default_rng([67, number]), LIGHT_STAGE[index])
    return Shape(number, head.vertices, head.faces, head.landmarks)


def shapes(quick: bool) -> Iterator[Case]:
    for index, (expression, features) in enumerate(OWN):
        yield Case(", ".join((f"own: {expression}", *features)), partial(own_shape, index))
        name = ", ".join(LIGHT_STAGE[index]) or "neutral"
        yield Case(f"light stage: {name} {index}", partial(light_stage_shape, index))
        if quick:
            return


def poses(shape: Shape, fitted: bool) -> list[FloatArray | None]:
    """Return `model_from_shape` (4, 4) of each capture, None where it was refused."""
    found: list[FloatArray | None] = []
    model = AnnotatedFaceModel.default()
    for seed in range(CAPTURES):
        scan, truth = stereo_scan_of(
            shape.vertices,
            shape.faces,
            shape.landmarks,
            shape.number,
            capture_seed=seed,
            features=shape.features,
        )
        try:
            answer: Any = register(scan, model)
            answer = fit(scan, model, answer) if fitted else answer
            found.append(answer.model_from_scan @ invert_rigid(truth.model_from_scan))
        except Scan2AlbedoError:
            found.append(None)
    return found


def about_their_mean(poses: Sequence[FloatArray], face: FloatArray) -> FloatArray:
    """Return (N, 2) degrees and mm at a point (3,) of the shape between poses (4, 4) and their mean.

    The mean rotation is the one nearest to the mean of the matrices.
    """
    stacked = np.stack(poses)
    u, _, vt = np.linalg.svd(stacked[:, :3, :3].mean(0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    places = np.stack([transform_points(pose, face[None])[0] for pose in stacked])
    turns = [np.degrees(rotation_angle_rad(pose[:3, :3] @ mean.T)) for pose in stacked]
    return np.stack([turns, np.linalg.norm(places - places.mean(0), axis=1)], 1)


def spread(shape: Shape, found: list[FloatArray | None]) -> dict[str, float]:
    known = [pose for pose in found if pose is not None]
    row = {"refused": float(len(found) - len(known))}
    if known:
        off = about_their_mean(known, shape.landmarks[17:].mean(0))
        near = np.all(off <= (NEAR_DEG, NEAR_MM), axis=1)
        row |= {"deg": float(off[:, 0].mean()), "worst deg": float(off[:, 0].max())}
        row |= {"mm": float(off[:, 1].mean()), "worst mm": float(off[:, 1].max())}
        row |= {"near %": float(100 * near.mean()), "all near %": 100.0 * bool(near.all())}
    return row


REGISTERED: dict[str, Callable[[Scene], Answer]] = {
    "scan2albedo": lambda scene: scene.register(scene.scan.scan)
}
BENCHES = {
    "faces": Bench(
        partial(cases, FACES), REGISTERED, judged_face, summaries=("mean", "median"), remarks=reliability
    ),
    "others": Bench(partial(cases, OTHERS), REGISTERED, judged_other),
    "repeat": Bench(
        shapes,
        {"registered": partial(poses, fitted=False), "fitted": partial(poses, fitted=True)},
        spread,
        slow=("fitted",),
    ),
}
