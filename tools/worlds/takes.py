"""A take of one moving face with ground truth: frames of raw-like scans, each of its own topology."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from worlds.light_stage import LightStage
from worlds.raw_like import raw_like

LAST = 60.0
"""Time at the end of a take, in frames."""
SCRIPTS: dict[str, dict[str, tuple[int, int]]] = {
    "person1": {
        "brow_inner_up": (2, 24),
        "jaw_open": (8, 36),
        "eye_blink": (20, 26),
        "mouth_pucker": (26, 52),
        "cheek_puff": (34, 58),
    },
    "person3": {
        "mouth_frown": (2, 28),
        "brow_down": (6, 40),
        "eye_blink": (14, 20),
        "mouth_funnel": (22, 50),
        "nose_sneer": (30, 56),
        "jaw_open": (32, 58),
    },
    "person4": {
        "jaw_open": (2, 18),
        "mouth_upper_up": (12, 34),
        "brow_inner_up": (20, 38),
        "mouth_roll_lower": (30, 46),
        "eye_blink": (40, 46),
        "cheek_puff": (42, 58),
    },
    "person2": {
        "cheek_puff": (2, 22),
        "jaw_open": (16, 32),
        "mouth_roll_upper": (28, 44),
        "nose_sneer": (34, 52),
        "mouth_frown": (40, 58),
    },
}
"""Of each person, when an expression comes and has gone. `process_sequence` was made with the first two; the
others judge."""


@dataclass(frozen=True)
class Take:
    """Scans of one face in the scanner's frame, and the true landmarks (T, 68, 3) there, mm."""

    frames: list[s2a.RawScan]
    landmarks: FloatArray


def take(person: str, script: Mapping[str, tuple[int, int]], *, count: int = 60, seed: int = 0) -> Take:
    """Return a take that ends as it begins, without expression; the head turns by 14 degrees meanwhile."""
    people = LightStage.load()
    moves = people.expressions
    frames, landmarks = list[s2a.RawScan](), []
    for number, time in enumerate(np.linspace(0, LAST, count)):
        shape = people.shapes[person].copy()
        for name, (begin, end) in script.items():
            shape += np.sin(np.pi * np.clip((time - begin) / (end - begin), 0, 1)) ** 2 * moves[name]
        turn = 2 * np.pi * time / LAST
        nod, shake, tilt = 5 * np.sin(2 * turn), 14 * np.sin(turn), 3 * np.sin(turn)
        shift = [8 * np.sin(turn), 5 * np.sin(2 * turn), 0]
        pose = compose(rotation_from_vector(np.deg2rad([nod, shake, tilt])), np.array(shift))
        shape, seed_ = transform_points(pose, shape), 1000 * seed + number
        still = {"rotation_max_deg": 0.0, "translation_max_mm": 0.0}
        frames.append(raw_like(shape, people.faces, seed_, noise_mm=0.15, **still)[0])  # type: ignore[arg-type]
        landmarks.append(shape[people.landmarks])
    return Take(frames, np.array(landmarks))
