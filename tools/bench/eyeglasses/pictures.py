"""Frames on painted faces in three pictures: what is proposed, how sure it is, and what registration gains.

Errors of the front with the head alone, with pictures, with labels (1 px off), and with both. Proposed key
points beside their stated deviations, proposed masks beside true ones. Nothing was chosen on these frames,
people and colours.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from bench.eyeglasses.painted import Pictured, pictured
from bench.eyeglasses.scenes import named
from bench.judging import rms
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses import RegisteredEyeglasses, register_on_face
from scan2albedo.synthetic import GlassesShape

UNSEEN = {
    "khronos": (10, "black", "clear"),
    "giraut": (11, "red", "clear"),
    "round": (12, "black", "clear"),
    "shield": (13, "tortoise", "dark"),
    "drawn 14": (14, "steel", "clear"),
    "drawn 15": (15, "black", "dark"),
}
"""Person, colour and lenses by frame."""
LABEL_PX = 1.0


@dataclass(frozen=True)
class Labelled:
    """A person in pictures, and labels (C, 20, 2) of all views."""

    shown: Pictured
    hand: FloatArray


def labelled(name: str, seed: int, color: str, glass: str) -> Labelled:
    frame = named(name, lambda number: GlassesShape.drawn(np.random.default_rng([number, 77])))
    shown = pictured(frame, seed, color, glass)
    return Labelled(shown, shown.labels + np.random.default_rng(seed).normal(0, LABEL_PX, shown.labels.shape))


def registered(scene: Labelled, labels: bool = False, pictures: bool = False) -> RegisteredEyeglasses:
    """Register with labels of all views or none, and with pictures."""
    shown, frame = scene.shown, scene.shown.frame
    return register_on_face(
        (frame.vertices, frame.faces, frame.keypoints, frame.weights()),
        scene.hand if labels else np.full_like(scene.hand, np.nan),
        None,
        shown.cameras,
        head=shown.head,
        shapes=[shown.masks.shape[1:]] * 3,
        pictures=list(shown.pictures) if pictures else None,
    )


def figures(scene: Labelled, found: RegisteredEyeglasses) -> dict[str, float]:
    shown, rest = scene.shown, scene.shown.frame.vertices
    error = np.linalg.norm(found.vertices - shown.vertices, axis=1)
    front = rest[:, 2] > np.nanmax(shown.frame.keypoints[:, 2]) - 20
    row = {"front mm": rms(error[front]), "observed mm": rms(error[found.observed])}
    off = np.linalg.norm(found.proposed_labels - shown.labels, axis=2)
    judged = np.isfinite(off)
    row["proposed"] = float(judged.sum())
    if judged.any():
        off, stated = off[judged], np.sqrt(2) * found.proposed_deviation_px[judged]
        row |= {"median px": float(np.median(off)), "rms px": rms(off), "stated px": rms(stated)}
        row["in 1 s"] = float((off <= stated).mean())
    pairs = [(a, b) for a, b in zip(found.proposed_masks, shown.masks, strict=True) if a is not None]
    if pairs:
        row["IoU"] = float(np.mean([(a & b).sum() / (a | b).sum() for a, b in pairs]))
    return row


BENCH = Bench(
    lambda quick: [
        Case(name, partial(labelled, name, *person))
        for name, person in list(UNSEEN.items())[4 if quick else 0 :][: 1 if quick else None]
    ],
    methods={
        "pictures": partial(registered, pictures=True),
        "head alone": registered,
        "labels": partial(registered, labels=True),
        "labels, pictures": partial(registered, labels=True, pictures=True),
    },
    score=figures,
    summaries=("median", "worst"),
)
