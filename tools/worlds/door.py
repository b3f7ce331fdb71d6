"""Scans for the door of the pipeline: faces in raw stereo with their true pose, and what shows no face."""

from dataclasses import dataclass, replace

import numpy as np

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.landmarks import PlacedLandmarks
from scan2albedo.geometry.rigid import invert_rigid, procrustes, transform_points
from worlds.light_stage import light_stage_head
from worlds.objects import random_body, random_relief
from worlds.stereo import SCRAPS, StereoScanner, StereoTruth, stereo_scan, stereo_scan_of

UNSEEN = 100_000
"""Added to the number of every scan: no calibration draws from there on."""
RIGID = slice(17, 48)
"""iBUG-68: brows, nose and eyes, which no expression moves far."""
HARD = StereoScanner(noise_mm=(1.5, 6.0), holes=(15, 60), reach_mm=(45.0, 170.0))
"""Three times the measured noise and holes and half the reach: about two in three faces are let in, so that
confidence is met with in every bin."""


@dataclass(frozen=True)
class Case:
    """A scan, and what is right about it."""

    scan: RawScan
    kinds: tuple[str, ...]
    """What the tables are broken down by."""
    model_from_scan: FloatArray | None = None
    """(4, 4): the pose that lays brows, nose and eyes on the default model's; None for what shows no face."""
    landmarks: FloatArray | None = None
    """(68, 3): in the model's frame at that pose."""


def face_case(scan: RawScan, truth: StereoTruth, *, rest: FloatArray | None = None) -> Case:
    """Return the case of a scan of a face; its landmarks at rest (68, 3), else the truth's, place it."""
    placed = AnnotatedFaceModel.default().landmarks
    assert placed is not None
    own = truth.landmarks if rest is None else rest
    model_from_head = procrustes(own[RIGID], placed[RIGID])
    landmarks = own @ model_from_head[:3, :3].T + model_from_head[:3, 3]
    kinds = (*(truth.features or ("plain",)), *filter(None, [truth.expression]))
    return Case(scan, kinds, model_from_head @ truth.model_from_scan, landmarks)


def own_person(number: int, scanner: StereoScanner = StereoScanner()) -> Case:
    """Return a random person of `stereo_scan`."""
    return face_case(*stereo_scan(UNSEEN + number, scanner=scanner))


def light_stage_person(number: int, scanner: StereoScanner = StereoScanner()) -> Case:
    """Return raw stereo of a mixture of light-stage people with a mixture of their expressions."""
    head = light_stage_head(np.random.default_rng([41, UNSEEN + number]))
    scan, truth = stereo_scan_of(head.vertices, head.faces, head.landmarks, UNSEEN + number, scanner=scanner)
    case = face_case(scan, truth, rest=head.rest)
    return Case(case.scan, (*case.kinds, *head.expressions), case.model_from_scan, case.landmarks)


PLACED = (30, 36, 45, 48, 54)
"""iBUG-68: tip of the nose, outer corners of the eyes, corners of the mouth."""
WRONG_BY_MM = (15.0, 16.0, 12.0)
"""How far off the last one is where one is placed wrongly: 25 mm."""
_PLACING_MM = 2.0
"""Standard deviation of a hand that places landmarks, along each axis."""


def with_landmarks(case: Case, seed: int, *, one_wrong: bool = False) -> Case:
    """Return the case with five landmarks placed to 2 mm along each axis; the last may be 25 mm off."""
    assert case.model_from_scan is not None
    assert case.landmarks is not None
    true = transform_points(invert_rigid(case.model_from_scan), case.landmarks)
    points = np.full_like(true, np.nan)
    noise = np.random.default_rng([seed, 5]).normal(scale=_PLACING_MM, size=(len(PLACED), 3))
    points[list(PLACED)] = true[list(PLACED)] + noise
    points[PLACED[-1]] += WRONG_BY_MM if one_wrong else 0.0
    return replace(case, scan=replace(case.scan, landmarks=PlacedLandmarks.of(points)))


def hard_person(number: int) -> Case:
    """Return a capture of either sort of people in turn that is far worse than any measured."""
    return (light_stage_person if number % 2 else own_person)(number, HARD)


def scrap(number: int) -> Case:
    """Return what raw stereo leaves of a head when it shows no face, of both sorts of people in turn."""
    place = SCRAPS[number // 2 % len(SCRAPS)]
    if number % 2:
        head = light_stage_head(np.random.default_rng([43, UNSEEN + number]))
        scan, _ = stereo_scan_of(head.vertices, head.faces, head.landmarks, UNSEEN + number, scrap=place)
    else:
        scan, _ = stereo_scan(UNSEEN + number, scrap=place)
    return Case(scan, (place,))


def relief(number: int) -> Case:
    """Return a random relief of a head's size on a shield, or a body with bumps, in turn."""
    rng = np.random.default_rng([47, UNSEEN + number])
    kind = ("relief", "body")[number % 2]
    mesh = random_body(rng) if number % 2 else random_relief(rng)
    return Case(RawScan(*mesh, name=f"{kind}-{number}"), (kind,))
