"""Key points and feature curves of the left half (x >= 0) of an average face.

Frame: origin at the nasion, +x the subject's left, +y up, +z out of the face, millimetres. Widths and
heights follow from `Measurements`; how points share them out in the front view is design. Depths follow
from published depths and angles through the laws of `profile`, `sections` and `features`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from face_model_generator.anthropometry import Measurements
from face_model_generator.features import LID_MARGIN_MM, PUPIL_HEIGHT_MM, Eye, Nose, arch_drop
from face_model_generator.profile import midline, tragion
from face_model_generator.sections import Midline, Sections
from scan2albedo.core.arrays import FloatArray

SPACING_MM = 9.0
"""Of key points along a section."""
BEFORE_EAR_MM = 18.0
"""How far before the tragion the face ends."""
JAW_TURN_MM, JAW_ROUND = -58.0, 1.7
"""Height at which the outline leaves the ear's front for the throat, and the roundness of that turn."""


@dataclass(frozen=True)
class HalfFace:
    """The design of one half.

    Parameters
    ----------
    curves : dict of str to (N, 3) float64
        Feature curves that the control mesh follows; curves share their end points where they meet.
    fill : (M, 3) float64
        Key points between the curves.
    middle : dict of str to (x, y, z)
        The midline's points by name.
    skin : Sections
        The face without eyes, nose and lips.
    """

    curves: dict[str, FloatArray]
    fill: FloatArray
    middle: Midline
    skin: Sections

    @property
    def points(self) -> FloatArray:
        """All key points (K, 3), each once."""
        stacked = np.concatenate([*self.curves.values(), self.fill])
        _, first = np.unique(np.round(stacked, 6), axis=0, return_index=True)
        return stacked[np.sort(first)]


@dataclass(frozen=True)
class Part:
    """Curves and key points of one feature."""

    curves: dict[str, FloatArray]
    fill: FloatArray


def half_face(m: Measurements) -> HalfFace:
    """Lay out the left half of the face from its measurements."""
    middle = midline(m)
    ear, skin = tragion(m, middle), Sections.of(m, middle)
    outline = _outline(skin, ear, middle)
    eye, mouth = _eye(m, Eye.of(m, ear, skin)), _mouth(m, middle, skin)
    nose = _nose(m, middle, Nose.of(m, middle, skin))
    curves = {"midline": np.array(list(middle.values())), "outline": outline}
    # Between sparse points the spline would let creases fade and swell.
    curves |= {name: _dense(curve) for name, curve in (eye.curves | mouth.curves).items()} | nose.curves
    fill = np.concatenate([eye.fill, mouth.fill, nose.fill, _section_fill(skin, outline)])
    return HalfFace(curves, fill, middle, skin)


def _dense(curve: FloatArray, step_mm: float = 2.0) -> FloatArray:
    """Return points about `step_mm` apart on a smooth curve through the given ones."""
    arc = _arc_length(curve)
    at = np.linspace(0, arc[-1], round(arc[-1] / step_mm) + 1)
    dense = PchipInterpolator(arc, curve)(at)
    dense[[0, -1]] = curve[[0, -1]]
    return dense


def _arc_length(curve: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])


def _with_depth(xy: ArrayLike, depth: ArrayLike) -> FloatArray:
    return np.column_stack([np.asarray(xy, float), depth])


def _outline(skin: Sections, ear: FloatArray, middle: Midline) -> FloatArray:
    """Return the boundary from the hairline over the ear's front and under the jaw to the throat.

    Along the hairline the front view is given, below it the side view: straight down before the ear,
    then a quarter of a superellipse to the throat.
    """
    tr, throat = middle["tr"], middle["throat"]
    hair = np.array([(14, tr[1] + 0.4), (28, tr[1] - 1.2), (40, 58.5), (49, 51), (56, 41), (61, 29),
                     (65, 15.5), (68.3, 2)])  # fmt: skip
    hair = _with_depth(hair, skin.depth(*hair.T))
    y = np.array([-11, -24, -41, -59, -76, -93.5, -107, -116, throat[1] + 1.4])
    front = ear[2] + BEFORE_EAR_MM
    down = np.clip((JAW_TURN_MM - y) / (JAW_TURN_MM - throat[1]), 0, 1)
    z = throat[2] + (front - throat[2]) * (1 - down**JAW_ROUND) ** (1 / JAW_ROUND)
    return np.concatenate([[tr], hair, np.column_stack([skin.width(y, z), y, z]), [throat]])


def _eye(m: Measurements, eye: Eye) -> Part:
    """Return the lid margins from the inner to the outer corner, the eyeball between them, the orbit.

    Rows run from corner to corner in the front view; a column holds (share of the eye's width, height
    in half openings above the pupil). The margins lie on the eyeball, the rows further off on lids.
    """
    en, ex, half = m.inner_eye_width_mm / 2, m.outer_eye_width_mm / 2, m.eye_opening_mm / 2

    def row(columns: list[tuple[float, float]]) -> FloatArray:
        return np.array([(en + share * (ex - en), PUPIL_HEIGHT_MM + up * half) for share, up in columns])

    upper = row([(0.1, 0.1), (0.27, 0.72), (0.48, 1), (0.7, 0.8), (0.87, 0.36)])
    lower = row([(0.1, -0.78), (0.27, -0.94), (0.48, -1), (0.7, -0.88), (0.87, -0.58)])
    ball = row([(0.1, -0.4), (0.27, -0.1), (0.48, 0), (0.7, -0.05), (0.87, -0.1)])
    around = row(
        [
            *[(-0.06, 0.62), (0.2, 1.45), (0.48, 1.75), (0.74, 1.5), (0.97, 0.75)],  # fold of the upper lid
            *[(-0.16, 1.7), (0.12, 2.2), (0.46, 2.4), (0.78, 2.25), (1.1, 1.5)],  # socket
            *[(0.02, -1.4), (0.24, -1.7), (0.5, -1.75), (0.76, -1.6), (0.98, -1.1)],  # lower lid
            *[(0.24, -2.5), (0.52, -2.55), (0.8, -2.4), (1.04, -1.9), (1.12, -0.1)],  # bag, side
        ]
    )
    margin = [_with_depth(xy, eye.cover(xy[:, 0], xy[:, 1], LID_MARGIN_MM)) for xy in (upper, lower)]
    curves = {
        name: np.concatenate([[eye.inner], lid, [eye.outer]])
        for name, lid in zip(("upper_lid", "lower_lid"), margin, strict=True)
    }
    rest = _with_depth(around, eye.lid(*around.T))
    return Part(curves, np.concatenate([_with_depth(ball, eye.cover(ball[:, 0], ball[:, 1], 0.0)), rest]))


def _mouth(m: Measurements, middle: Midline, skin: Sections) -> Part:
    """Return vermilion borders and mouth line from the midline to the corner, and the lips between.

    Every row has the same columns (shares of the half width), so that the lips are lofted without
    wrinkles. The mouth line follows the dental arch; before it, rows stand as far as on the midline,
    less toward the corner as a parabola's ordinates do.
    """
    half, sto = m.mouth_width_mm / 2, middle["sto"]
    shares = np.array([0.2, 0.4, 0.6, 0.8])
    line = np.column_stack([half * shares, sto[1] - 1.4 * shares**2, sto[2] - arch_drop(m, half * shares)])
    corner = (half, sto[1] - 1.4, sto[2] - float(arch_drop(m, half)))

    def row(height: tuple[float, ...], name: str) -> FloatArray:
        before = (middle[name][2] - sto[2]) * (1 - shares**2)
        return line + np.column_stack([np.zeros(4), height, before])

    top, bottom = middle["ls"][1] - sto[1], middle["li"][1] - sto[1]
    upper_border = row((top + 0.9, top - 0.9, top - 3.0, top - 5.5), "ls")
    lower_border = row((bottom + 0.2, bottom + 1.1, bottom + 3.0, bottom + 5.6), "li")
    upper_lip, lower_lip = row((4.4, 3.9, 2.8, 1.4), "upper_lip"), row((-4.4, -3.9, -2.9, -1.7), "lower_lip")
    curves = {
        "upper_vermilion": np.concatenate([[middle["ls"]], upper_border, [corner]]),
        "mouth_line": np.concatenate([[sto], line, [corner]]),
        "lower_vermilion": np.concatenate([[middle["li"]], lower_border, [corner]]),
        "upper_lip": np.concatenate([[middle["upper_lip"]], upper_lip[:3]]),
        "lower_lip": np.concatenate([[middle["lower_lip"]], lower_lip[:3]]),
    }
    rows = [
        np.column_stack([line[:, 0], line[:, 1] + height])
        for height in ((12.2, 11.6, 10.6, 9.4), (-13.2, -12.4, -10.4, -7.6))
    ]
    sides = [(29, -69), (30.5, -75), (28, -81), (26.5, -64), (16.5, -57), (9.5, -57.4), (9, sto[1] - 18),
             (17.5, sto[1] - 17)]  # fmt: skip
    around = np.concatenate([*rows, sides])
    skin_around = _with_depth(around, skin.depth(*around.T))
    return Part(curves, np.concatenate([upper_lip[3:], lower_lip[3:], skin_around]))


def _nose(m: Measurements, middle: Midline, nose: Nose) -> Part:
    """Return the crease around the wing, the lower rim from columella to wing, and the nose's surface."""
    wing = m.nose_width_mm / 33
    bridge = np.array([
        (5, 2), (9.5, 2.5), (5, -5), (9.5, -6), (13, -7), (4.5, -12), (8.5, -12.5), (12.5, -13.5),
        (16, -14.5), (4.5, -20.5), (8.5, -21), (12.5, -22), (16.5, -23), (4.5, -29), (8.8, -29.5),
        (12.8, -30.5), (16.8, -31.5),
    ])  # fmt: skip
    tip_and_wing = np.array([
        (5, -35), (9, -35.6), (12, -36), (5.4, -39.6), (9.2, -40.6), (4.6, -43.6), (8.4, -44.4),
        (10.8, -42.4), (10.2, -45.6), (12.8, -39.8), (14.6, -41.2), (16, -42.6), (14.4, -43.8),
        (16.3, -45.4), (14.8, -46.4), (12.6, -45.2),
    ]) * [wing, 1]  # fmt: skip
    rim_xy = np.array([(3.4, -48.4), (6.8, -47.6), (10, -47.2), (12.6, -47.8), (14.4, -48.4), (15.3, -49)])
    crease_xy = np.array([(13.4, -36.4), (15.9, -39.6), (16.9, -44.2), (15.8, -48.6), (12.4, -51.2)])
    crease_xy, rim_xy = crease_xy * [wing, 1], rim_xy * [wing, 1]
    crease = _with_depth(crease_xy, nose.crease(*crease_xy.T))
    rim = _with_depth(rim_xy, nose.rim(rim_xy[:, 0]))
    under = np.array([(7, -49.4), (9.4, -49.4), (12, -49.8), (3.6, -51.4), (9.6, -51.2), (6.2, -52.6),
                      (10, -53.6)]) * [wing, 1]  # fmt: skip
    base = nose.base(under[:, 0], under[:, 1], np.interp(under[:, 0], rim_xy[:, 0], rim_xy[:, 1]))
    surface = np.concatenate([bridge, tip_and_wing])
    curves = {"alar_crease": crease, "nose_rim": np.concatenate([[middle["columella"]], rim])}
    return Part(
        curves,
        np.concatenate([_with_depth(surface, nose.depth(*surface.T)), _with_depth(under, base)]),
    )


_ROWS = (
    # height, from x, to x (the outline where none)
    (51, 12, None), (38, 12, None), (25, 10, None), (16, 8, None), (9, 7, 8), (9, 55, None), (-5, 56, None),
    (-16, 46, None), (-21, 22, 39), (-28, 22, None), (-38, 22, None), (-48, 22, None), (-60, 23, None),
    (-74, 37, None), (-86, 27, None), (-97, 9, None), (-107, 8, None), (-115, 8, None), (-119, 8, None),
)  # fmt: skip
"""Horizontal rows of key points between the features."""


def _section_fill(skin: Sections, outline: FloatArray) -> FloatArray:
    """Return key points about `SPACING_MM` apart along horizontal sections, up to the outline."""
    descending = outline[np.argmax(outline[:, 1]) :]
    rows = []
    for height, first, last in _ROWS:
        edge = np.interp(-height, -descending[:, 1], descending[:, 0]) if last is None else last
        # Dense toward the edge, where the section turns back.
        x = edge - (edge - first) * np.linspace(1, 0, 200) ** 2
        section = np.column_stack([x, np.full(200, height), skin.depth(x, np.full(200, float(height)))])
        arc = _arc_length(section)
        room = arc[-1] - (0.6 * SPACING_MM if last is None else 0.0)
        at = np.linspace(0, max(room, 0), max(round(room / SPACING_MM), 0) + 1)
        rows.append(np.column_stack([np.interp(at, arc, section[:, k]) for k in range(3)]))
    return np.concatenate(rows)
