"""The 68 iBUG landmarks of the default model."""

from __future__ import annotations

import numpy as np

from face_model_generator.sections import Midline, Sections
from scan2albedo.core.arrays import FloatArray

LEFT_TO_RIGHT = (
    (16, 0), (15, 1), (14, 2), (13, 3), (12, 4), (11, 5), (10, 6), (9, 7),
    (22, 21), (23, 20), (24, 19), (25, 18), (26, 17), (34, 32), (35, 31),
    (42, 39), (43, 38), (44, 37), (45, 36), (46, 41), (47, 40),
    (52, 50), (53, 49), (54, 48), (55, 59), (56, 58), (63, 61), (64, 60), (65, 67),
)  # fmt: skip
"""Pairs (landmark on the subject's left, its mirror image on the right)."""

MIDDLE = (8, 27, 28, 29, 30, 33, 51, 57, 62, 66)
"""Landmarks on the midline."""


def half_landmarks(curves: dict[str, FloatArray], middle: Midline, skin: Sections) -> dict[int, FloatArray]:
    """Return design positions of the midline's and the left half's landmarks, near the surface.

    Parameters
    ----------
    curves : dict of str to (N, 3) float64
        Feature curves of the left half in the design frame.
    middle : dict of str to (x, y, z)
        The midline's points by name.
    skin : Sections
        The face on which brow, chin and jaw lie.
    """
    upper, lower = curves["upper_lid"], curves["lower_lid"]
    top, bottom = curves["upper_vermilion"], curves["lower_vermilion"]
    line, under = curves["mouth_line"], curves["lower_mouth_line"]
    sets = {
        42: upper[0], 43: _share(upper, 0.38), 44: _share(upper, 0.74), 45: upper[-1],
        46: _share(lower, 0.75), 47: _share(lower, 0.37),
        51: top[0], 52: _share(top, 0.24), 53: _share(top, 0.64), 54: top[-1],
        57: bottom[0], 56: _share(bottom, 0.38), 55: _share(bottom, 0.66),
        62: line[0], 63: _share(line, 0.38), 64: _share(line, 0.86),
        65: _share(under, 0.38), 66: under[0],
    }  # fmt: skip
    crease = curves["alar_crease"][-1]
    sets |= {
        number: np.array(middle[name]) for number, name in ((8, "gn"), (27, "n"), (30, "prn"), (33, "sn"))
    }
    sets |= {28: (2 * sets[27] + sets[30]) / 3, 29: (sets[27] + 2 * sets[30]) / 3}
    sets |= {34: 0.5 * (sets[33] + crease), 35: crease}
    return sets | _contour(curves["outline"], skin)


_BROW = {22: (11.5, 19.0), 23: (24.0, 22.0), 24: (38.0, 22.8), 25: (49.5, 20.0), 26: (58.5, 12.8)}
_CHIN = {9: (15.5, -115.5), 10: (30.0, -110.0)}
_JAW = {
    11: (-100.5, 12.0),
    12: (-83.0, 12.0),
    13: (-63.0, 10.0),
    14: (-43.0, 8.0),
    15: (-23.0, 5.0),
    16: (-2.0, 0.0),
}
"""Front view (x, y) of brow and chin; of the jaw, (y, depth before the outline)."""


def _contour(outline: FloatArray, skin: Sections) -> dict[int, FloatArray]:
    """Return brow, chin and jaw landmarks on the face's sections."""
    found = {k: np.array([x, y, float(skin.depth(x, y))]) for k, (x, y) in (_BROW | _CHIN).items()}
    falling = outline[np.argmax(outline[:, 1]) :]
    for number, (y, before) in _JAW.items():
        z = np.interp(-y, -falling[:, 1], falling[:, 2]) + before
        found[number] = np.array([float(skin.width(y, z)), y, z])
    return found


def _share(curve: FloatArray, share: float) -> FloatArray:
    """Return the point of a curve at a share of its width in x."""
    x = curve[0, 0] + share * (curve[-1, 0] - curve[0, 0])
    return np.array([x, np.interp(x, curve[:, 0], curve[:, 1]), np.interp(x, curve[:, 0], curve[:, 2])])
