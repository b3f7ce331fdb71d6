"""The 68 iBUG landmarks of the default model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEFT_TO_RIGHT = (
    (16, 0), (15, 1), (14, 2), (13, 3), (12, 4), (11, 5), (10, 6), (9, 7),
    (22, 21), (23, 20), (24, 19), (25, 18), (26, 17), (34, 32), (35, 31),
    (42, 39), (43, 38), (44, 37), (45, 36), (46, 41), (47, 40),
    (52, 50), (53, 49), (54, 48), (55, 59), (56, 58), (63, 61), (64, 60), (65, 67),
)  # fmt: skip
"""Pairs (landmark on the subject's left, its mirror image on the right)."""

MIDDLE = (8, 27, 28, 29, 30, 33, 51, 57, 62, 66)
"""Landmarks on the midline."""


def half_landmarks(curves: dict[str, FloatArray]) -> dict[int, FloatArray]:
    """Return design positions of the midline's and the left half's landmarks, near the surface.

    Parameters
    ----------
    curves : dict of str to (N, 3) float64
        Feature curves of the left half in the design frame.
    """
    upper, lower = curves["upper_lid"], curves["lower_lid"]
    top, line, bottom = curves["upper_vermilion"], curves["mouth_line"], curves["lower_vermilion"]
    sets = {
        42: upper[0], 43: _share(upper, 0.38), 44: _share(upper, 0.74), 45: upper[-1],
        46: _share(lower, 0.75), 47: _share(lower, 0.37),
        51: top[0], 52: _share(top, 0.24), 53: _share(top, 0.64), 54: top[-1],
        57: bottom[0], 56: _share(bottom, 0.38), 55: _share(bottom, 0.66),
        62: line[0], 63: _share(line, 0.38), 64: _share(line, 0.86),
        65: _share(line, 0.38) - [0, 0.4, 0], 66: line[0] - [0, 0.4, 0],
    }  # fmt: skip
    return sets | {k: np.array(v, float) for k, v in _TABLE.items()}


_TABLE: dict[int, tuple[float, float, float]] = {
    8: (0, -117, -6), 9: (15.5, -115.5, -9), 10: (30, -110, -21), 11: (43, -100.5, -35),
    12: (55.5, -83, -48), 13: (63.5, -63, -57), 14: (67.5, -43, -62), 15: (69.6, -23, -66),
    16: (69.5, -2, -66),
    22: (11.5, 19, -0.5), 23: (24, 22, -3), 24: (38, 22.8, -9.5),
    25: (49.5, 20, -17.5), 26: (58.5, 12.8, -30),
    27: (0, 0, 0), 28: (0, -12, 7.2), 29: (0, -23, 14.2), 30: (0, -38.2, 22.5),
    33: (0, -52, 8), 34: (6, -51.8, 6.8), 35: (12, -51.2, 2.2),
}  # fmt: skip


def _share(curve: FloatArray, share: float) -> FloatArray:
    """Return the point of a curve at a share of its width in x."""
    x = curve[0, 0] + share * (curve[-1, 0] - curve[0, 0])
    return np.array([x, np.interp(x, curve[:, 0], curve[:, 1]), np.interp(x, curve[:, 0], curve[:, 2])])
