"""Glasses on a face: rms of the visible vertices against the steps taken and the pixels looked at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from benchmarks.sweep import ErrorKind, Outcome, Peer, Setting, StageBenchmark, timed, varied, within
from scan2albedo.core import Budget, ProgressCallback
from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses import (
    FaceRegistrationOptions,
    RegisteredEyeglasses,
    bounded_biharmonic_weights,
    register_on_face,
)
from scan2albedo.synthetic import Wearer, wearer

_SCENES, _QUICK_SCENES = 4, 1
QUICK_WEARER_PX = (256, 450.0)
"""Size of the pictures and focal length of a wearer for quick runs; 1024 and 1800 by default."""


@dataclass(frozen=True)
class WornGlasses:
    """A synthetic wearer and the weights (V, 20) of the frame at rest."""

    worn: Wearer
    weights: FloatArray


@cache
def worn_glasses(seed: int, picture_size: int = 1024, focal_px: float = 1800.0) -> WornGlasses:
    """Return a wearer with the weights of the frame, which the registration is given."""
    worn = wearer(seed, picture_size=picture_size, focal_px=focal_px)
    glasses = worn.glasses
    weights = bounded_biharmonic_weights(glasses.rest_vertices, glasses.faces, glasses.rest_keypoints)
    return WornGlasses(worn, weights)


def registered(
    scene: WornGlasses,
    options: FaceRegistrationOptions,
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> RegisteredEyeglasses:
    """Register a wearer's frame with all that is known."""
    worn, glasses = scene.worn, scene.worn.glasses
    frame = (glasses.rest_vertices, glasses.faces, glasses.rest_keypoints, scene.weights)
    head = (worn.head_vertices, worn.head_faces)
    return register_on_face(
        frame,
        worn.labels,
        worn.masks,
        worn.cameras,
        budget,
        head=head,
        options=options,
        on_progress=on_progress,
    )


def rms_mm(vertices: FloatArray, worn: Wearer) -> float:
    """Return the rms distance of the vertices (V, 3) that the head leaves visible in some view."""
    return float(np.sqrt((np.linalg.norm(vertices - worn.vertices, axis=1)[worn.seen] ** 2).mean()))


def _settings(quick: bool) -> list[Setting]:
    options = FaceRegistrationOptions()
    default = Setting("default", "", options)
    if quick:
        return [default, *within(options, (4,))]
    return [
        default,
        *varied("bend", options, (False,)),
        *within(options, (2, 4, 8, 12, 16, 24, 32, 48)),
    ]


def _run(scene: WornGlasses, setting: Setting) -> Outcome:
    found, cost = timed(lambda: registered(scene, setting.options, setting.budget))
    return Outcome(cost, (rms_mm(found.vertices, scene.worn),), found.iterations)


def _peers(quick: bool) -> list[Peer]:
    return []


def _scenes(quick: bool) -> list[WornGlasses]:
    if quick:
        return [worn_glasses(seed, *QUICK_WEARER_PX) for seed in range(_QUICK_SCENES)]
    return [worn_glasses(seed) for seed in range(_SCENES)]


BENCHMARK = StageBenchmark(
    "glasses", (ErrorKind("visible vertices, rms", "mm"),), _scenes, _settings, _run, _peers
)
