"""Several captures of one shape: how far the poses found are from their mean."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from worlds.door import UNSEEN
from worlds.light_stage import light_stage_head
from worlds.stereo import stereo_scan_of

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.fitting import fit
from scan2albedo.geometry.rigid import invert_rigid, rotation_angle_rad, transform_points
from scan2albedo.registration import register
from scan2albedo.synthetic.face_shape import Expression
from scan2albedo.synthetic.sitter import sit_down

NEAR_DEG, NEAR_MM = 1.0, 1.5
CAPTURES = 10
_OWN: tuple[tuple[Expression, tuple[str, ...]], ...] = (
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
_LIGHT_STAGE: tuple[dict[str, float], ...] = (
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
SHAPES = len(_OWN) + len(_LIGHT_STAGE)


@dataclass(frozen=True)
class Capture:
    """The poses (4, 4) that one capture gave, `model_from_shape`; None where it was refused, or not asked."""

    shape: int
    name: str
    registered: FloatArray | None
    fitted: FloatArray | None
    confidence: float | None
    face: FloatArray
    """(3,): middle of brows, eyes, nose and mouth in the shape's frame, mm."""
    cpu_s: float


@dataclass(frozen=True)
class _Shape:
    name: str
    vertices: FloatArray
    faces: IntArray
    landmarks: FloatArray
    features: tuple[str, ...]


@lru_cache(maxsize=2)
def _shape(number: int) -> _Shape:
    """Return one of the shapes: own people and light-stage ones in turn."""
    index = number // 2 % len(_OWN)
    if number % 2:
        expressions = _LIGHT_STAGE[index]
        head = light_stage_head(np.random.default_rng([67, UNSEEN + number]), expressions)
        name = "light stage: " + (", ".join(expressions) or "neutral")
        return _Shape(name, head.vertices, head.faces, head.landmarks, ())
    expression, features = _OWN[index]
    model = AnnotatedFaceModel.default()
    sitter = sit_down(UNSEEN + number, expression=expression, model=model)
    name = ", ".join((f"own: {expression}", *features))
    return _Shape(name, sitter.vertices, sitter.faces, sitter.face.landmarks, features)


def captured(shape_number: int, capture_seed: int, *, fitting: bool) -> Capture:
    """Scan a shape once more, register the scan and, when `fitting`, fit it."""
    shape, model = _shape(shape_number), AnnotatedFaceModel.default()
    scan, truth = stereo_scan_of(
        shape.vertices,
        shape.faces,
        shape.landmarks,
        UNSEEN + shape_number,
        capture_seed=capture_seed,
        features=shape.features,
    )
    scan_from_shape = invert_rigid(truth.model_from_scan)
    registered, fitted, confidence, cpu_s = None, None, None, 0.0
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = register(scan, model)
            cpu_s = time.process_time() - begin
            registered, confidence = found.model_from_scan @ scan_from_shape, found.confidence
            if fitting:
                fitted = fit(scan, model, found).model_from_scan @ scan_from_shape
        except Scan2AlbedoError:
            cpu_s = cpu_s or time.process_time() - begin
    face = shape.landmarks[17:].mean(0)
    return Capture(shape_number, shape.name, registered, fitted, confidence, face, cpu_s)


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


def print_repeats(captures: Sequence[Capture]) -> None:
    """Print the spread of the poses of each shape, those of `register` and those that fits ended with."""
    fits = any(capture.fitted is not None for capture in captures)
    ways = ("registered", "fitted") if fits else ("registered",)
    head = "".join(f"{way + ': near':>20}{'mean deg/mm':>16}{'worst deg/mm':>16}" for way in ways)
    print(f"\n{'repeat: shape':40}{head}{'refused':>9}")
    total: dict[str, list[FloatArray]] = {way: [] for way in ways}
    for number in sorted({capture.shape for capture in captures}):
        own = [capture for capture in captures if capture.shape == number]
        text = f"{own[0].name:40}"
        for way in ways:
            poses = [pose for capture in own if (pose := getattr(capture, way)) is not None]
            spread = about_their_mean(poses, own[0].face) if poses else np.zeros((0, 2))
            total[way].append(spread)
            text += _spread_text(spread)
        print(f"{text}{sum(capture.registered is None for capture in own):9}")
    print(f"{'all':40}" + "".join(_spread_text(np.concatenate(total[way])) for way in ways))
    bound = f"{NEAR_DEG} degree / {NEAR_MM} mm"
    for way in ways:
        near = sum(len(spread) > 0 and bool(_near(spread).all()) for spread in total[way])
        print(f"{way}: {near} of {len(total[way])} shapes with every pose within {bound}")
    print(f"CPU of register: median {np.median([capture.cpu_s for capture in captures]):.2f} s")


def _near(spread: FloatArray) -> BoolArray:
    return np.all(spread <= (NEAR_DEG, NEAR_MM), axis=1)


def _spread_text(spread: FloatArray) -> str:
    if not len(spread):
        return f"{'-':>20}{'-':>16}{'-':>16}"
    near = _near(spread)
    mean, worst = ("{:.2f} / {:.2f}".format(*values) for values in (spread.mean(0), spread.max(0)))
    return f"{f'{near.sum()}/{len(near)}':>20}{mean:>16}{worst:>16}"
