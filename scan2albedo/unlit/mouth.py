"""The inside of a mouth behind a face's lips: a bag, and both rows of teeth, as usual ones are."""

import math

import numpy as np
from scipy.interpolate import CubicSpline

from scan2albedo.core.arrays import FloatArray, grid_faces, norms, smoothstep
from scan2albedo.io.glb import GlbPart
from scan2albedo.unlit.eyes import wet_part
from scan2albedo.unlit.face_features import texels_of_parts
from scan2albedo.unlit.processed_face import ProcessedFace

RIM_LANDMARKS = slice(60, 68)
"""Of iBUG-68: the lips' inner rim, from its right corner over the upper lip."""
LIP_LANDMARKS = [48, 50, 51, 52, 54, 56, 57, 58]
"""Those of the outer rim beside them, which are on one lip even where lips touch."""
JAW_LANDMARKS = [8, 57]
"""Chin and lower lip, between which the lower teeth move."""
LIP_MM = 8.0
"""Thickness of lips."""
TOOTH_MM = 7.5
"""Width of a tooth."""
HALF_MM = (29.0, 16.0)
"""Half of a mouth's width and height."""
DEPTH_MM = 40.0
"""Depth of a mouth."""
RED = (0.5, 0.25, 0.2)
"""Albedo of usual lips, as parts of the white of an eye."""
TEETH = (1.1, 1.03, 0.9)
"""Albedo of teeth, as parts of the white of an eye."""


def mouth_parts(face: ProcessedFace, landmarks: FloatArray, white: FloatArray) -> list[GlbPart]:
    """Return the inside of a mouth as a bag behind the lips' inner rim, and both rows of teeth.

    `landmarks` are (68, 3), `white` (3,) the albedo of an eye's white.
    """
    lips = texels_of_parts(face, ["lip", "upper_lip", "lower_lip"]) & face.image.seen
    red: FloatArray = np.median(face.albedo_linear[lips], axis=0) if lips.any() else white * RED
    gums = 0.7 * red
    rim = landmarks[RIM_LANDMARKS]
    return [
        _bag(rim, gums),
        _teeth("teeth_upper", rim, rim[2, 1] - 2, 1, gums, white),
        _teeth("teeth_lower", rim, rim[6, 1], -1, gums, white),
    ]


def _bag(rim: FloatArray, gums: FloatArray) -> GlbPart:
    """Return the bag behind an inner rim (8, 3)."""
    # How a closed curve through the eight landmarks follows them: (C, 8).
    knots, around = np.linspace(0, 1, 9), np.linspace(0, 1, 40, endpoint=False)
    blend = CubicSpline(knots, np.vstack([np.eye(8), np.eye(8)[:1]]), bc_type="periodic")(around)
    # It begins behind the lips, wider than they are open, and is as wide as a mouth before the teeth.
    middle, back = rim.mean(0), np.linspace(0, 1, 16)[:, None, None] ** 2
    angle = math.pi - 2 * math.pi * around
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    wide = smoothstep(2 * DEPTH_MM * back / LIP_MM)
    start = blend @ rim + LIP_MM / 4 * np.column_stack([circle * (0, 2), np.full(len(circle), -4)])
    xy = (1 - wide) * start[:, :2] + wide * (middle[:2] + np.sqrt(1 - back**2) * HALF_MM * circle)
    z = (1 - back) * start[:, 2:] + back * middle[2] - DEPTH_MM * back
    bag = np.concatenate([xy, np.broadcast_to(z, (*xy.shape[:2], 1))], -1)
    follows = np.zeros((*bag.shape[:2], 68))
    follows[..., LIP_LANDMARKS] = (1 - wide) * blend
    below = wide[..., 0] * np.clip(-np.sin(angle), 0, 1) * (1 - back[..., 0])
    follows[..., JAW_LANDMARKS] += below[..., None] / 2
    faces = grid_faces(*bag.shape[:2], wrap=True)
    colors = np.repeat((1 - 0.8 * np.sqrt(back[:, 0])) * gums, len(around), axis=0)  # dark inside
    return wet_part("mouth", bag.reshape(-1, 3), faces, colors, follows.reshape(-1, 68))


def _teeth(
    name: str, rim: FloatArray, edge_mm: float, up: int, gums: FloatArray, white: FloatArray
) -> GlbPart:
    """Return a row of teeth: half an ellipse from the gums over the edges and back to the gums.

    `edge_mm` is the height of the edges, `up` 1 for upper teeth and -1 for lower ones, which lie behind them.
    """
    inward = 0.0 if up > 0 else 2.5
    turn = np.radians(np.linspace(-75, 75, 121))
    arch = np.stack([27 * np.sin(turn), 38 * (np.cos(turn) - 1)], -1)
    along = np.cumsum(norms(np.diff(arch, axis=0, prepend=arch[:1])))
    gap = np.exp(-(((along - along[60] + TOOTH_MM / 2) % TOOTH_MM - TOOTH_MM / 2) ** 2))
    rows = []
    for high, thick in ((10, 0.0), (0, 0.0), (0, 2.0), (10, 5.0)):
        shrunk = arch * (1 - (thick + inward + gap[:, None] / 2) / 30)
        y = np.full(len(arch), edge_mm + up * high)
        z = min(rim[2, 2], rim[6, 2]) - LIP_MM - thick - inward + shrunk[:, 1]
        rows.append(np.stack([rim.mean(0)[0] + shrunk[:, 0], y, z], -1))
    tooth = white * TEETH * (1 - 0.6 * gap[:, None])
    gum = np.tile(gums, (len(arch), 1))
    moves = np.zeros((4 * len(arch), 68))
    moves[:, JAW_LANDMARKS] = (up < 0) / 2
    strip = grid_faces(4, len(arch))[:, ::up]
    return wet_part(name, np.concatenate(rows), strip, np.concatenate([gum, tooth, tooth, gum]), moves)
