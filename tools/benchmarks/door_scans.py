"""Scans for the door of the pipeline: faces in raw stereo with their true pose, and what shows no face."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from benchmarks.scan_files import face_data
from benchmarks.stereo_scan import SCRAPS, StereoScanner, StereoTruth, stereo_scan, stereo_scan_of
from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.landmarks import PlacedLandmarks
from scan2albedo.geometry.mesh import boundary_loops
from scan2albedo.geometry.rigid import invert_rigid, procrustes, transform_points
from scan2albedo.synthetic.sitter import Mesh, grid_faces, hair_shell, join

UNSEEN = 100_000
"""Added to the number of every scan: no calibration draws from there on."""
RIGID = slice(17, 48)
"""iBUG-68: brows, nose and eyes, which no expression moves far."""
HARD = StereoScanner(noise_mm=(1.5, 6.0), holes=(15, 60), reach_mm=(45.0, 170.0))
"""Three times the measured noise and holes and half the reach: about two in three faces are let in, so that
confidence is met with in every bin."""
_SPREAD = 0.35
"""Standard deviation of the weights of light-stage identities about their mean."""
_EYE_MM = 4.0
_HAIR_SHARE = 0.7


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
_PLACING_MM = 2.0


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


@dataclass(frozen=True)
class LightStageHead:
    """A head: `vertices` (V, 3) mm, `faces` (F, 3), `landmarks` and those at `rest` (68, 3)."""

    vertices: FloatArray
    faces: IntArray
    landmarks: FloatArray
    rest: FloatArray
    expressions: tuple[str, ...]


@dataclass(frozen=True)
class _LightStageSet:
    identities: FloatArray
    """(P, V, 3)"""
    expressions: dict[str, FloatArray]
    faces: IntArray
    landmarks: IntArray


@cache
def _light_stage() -> _LightStageSet:
    with np.load(face_data("ict_faces.npz")) as data:
        names = ("generic_neutral", "person1", "person2", "person3", "person4")
        identities = np.stack([data[f"shape_{name}"].astype(float) for name in names])
        smile = data["shape_generic_mouthSmile_L_mouthSmile_R"] - identities[0]
        faces, landmarks = data["faces"].astype(np.int64), data["landmarks68"].astype(np.int64)
    with np.load(face_data("ict_expressions.npz")) as data:
        expressions = {name: data[name].astype(float) for name in sorted(data)}
    return _LightStageSet(identities, {**expressions, "smile": smile}, faces, landmarks)


def light_stage_head(
    rng: np.random.Generator, expressions: dict[str, float] | None = None, *, hair: bool = True
) -> LightStageHead:
    """Return a random person's head; up to three expressions are drawn, with any weight, when None.

    Eyes and the mouth, which are holes in the set, are closed: by balls, and by a pit as deep as the mouth
    is open.
    """
    data = _light_stage()
    if expressions is None:
        drawn = rng.choice(sorted(data.expressions), rng.integers(4), replace=False)
        expressions = {str(name): float(rng.uniform(0.2, 1.0)) for name in drawn}
    weights = rng.normal(scale=_SPREAD, size=len(data.identities))
    weights += 1 / len(weights) - weights.mean()
    rest = np.einsum("p,pvc->vc", weights, data.identities)
    moved = rest.copy()
    for name, amount in expressions.items():
        moved += amount * data.expressions[name]
    mesh = _closed(moved, data.faces, data.landmarks)
    if hair and rng.uniform() < _HAIR_SHARE:
        thick, drop = rng.uniform(5, 18), rng.uniform(0, 30)
        mesh = join([mesh, hair_shell(*mesh, rng, thickness_mm=thick, side_drop_deg=drop)])
    at = data.landmarks
    return LightStageHead(mesh[0], mesh[1], moved[at], rest[at], tuple(expressions))


def _closed(vertices: FloatArray, faces: IntArray, landmarks: IntArray) -> Mesh:
    """Return the head with fans over its eyes and its mouth."""
    points, fans = [vertices], [faces]
    mouth = vertices[landmarks[48:]].mean(0)
    for loop in boundary_loops(faces):
        rim = vertices[loop]
        if np.ptp(rim[:, 0]) > 100:  # below the neck
            continue
        in_mouth = np.linalg.norm(rim.mean(0) - mouth) < 25
        depth = -0.5 * np.ptp(rim[:, 1]) if in_mouth else _EYE_MM
        middle = np.full(len(loop), sum(map(len, points)))
        points.append((rim.mean(0) + [0, 0, depth])[None])
        fans.append(np.stack([np.roll(loop, -1), loop, middle], 1))
    return np.concatenate(points), np.concatenate(fans)


def relief(number: int) -> Case:
    """Return a random relief of a head's size on a shield, or a body with bumps, in turn."""
    rng = np.random.default_rng([47, UNSEEN + number])
    kind = ("relief", "body")[number % 2]
    mesh = random_body(rng) if number % 2 else random_relief(rng)
    return Case(RawScan(*mesh, name=f"{kind}-{number}"), (kind,))


def random_relief(rng: np.random.Generator) -> Mesh:
    """Return a shield of 220 x 260 mm with waves of three lengths."""
    size = 70
    height = np.zeros((size, size))
    for amplitude_mm, length in ((12, 8), (5, 4), (1.5, 1.5)):
        noise = gaussian_filter(rng.normal(size=(size, size)), length)
        height += amplitude_mm * noise / noise.std()
    x, y = np.meshgrid(np.linspace(-110, 110, size), np.linspace(-130, 130, size))
    z = 60 * np.sqrt(np.maximum(0, 1 - (x / 140) ** 2 - (y / 170) ** 2)) + height
    return np.stack([x, y, z], -1).reshape(-1, 3), grid_faces(size, size)[:, ::-1]


def random_body(rng: np.random.Generator) -> Mesh:
    """Return an ellipsoid of a head's size with 25 bumps and dents."""
    ball = trimesh.creation.icosphere(4)
    unit = np.asarray(ball.vertices)
    height = np.zeros(len(unit))
    for _ in range(25):
        center, width = rng.normal(size=3) / 1.2, rng.uniform(0.15, 0.5)
        height += rng.normal() * np.exp(-((unit - center) ** 2).sum(1) / (2 * width**2))
    return unit * (1 + 0.1 * height)[:, None] * [75.0, 100.0, 90.0], np.asarray(ball.faces, np.int64)
