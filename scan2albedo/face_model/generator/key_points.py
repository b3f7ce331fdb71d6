"""Key points and feature curves of the left half (x >= 0) of an average face.

Frame: origin at the nasion, +x the subject's left, +y up, +z out of the face, millimetres. Widths and
heights follow from `Measurements`. Depths, which the literature hardly tabulates, were set by hand and
corrected against depths read off horizontal and midline sections of measured faces; no vertex is theirs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from scan2albedo.face_model.generator.anthropometry import Measurements

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class HalfFace:
    """The design of one half.

    Parameters
    ----------
    curves : dict of str to (N, 3) float64
        Feature curves that the control mesh follows; curves share their end points where they meet.
    fill : (M, 3) float64
        Key points between the curves.
    """

    curves: dict[str, FloatArray]
    fill: FloatArray

    @property
    def points(self) -> FloatArray:
        """All key points (K, 3), each once."""
        stacked = np.concatenate([*self.curves.values(), self.fill])
        _, first = np.unique(np.round(stacked, 6), axis=0, return_index=True)
        return stacked[np.sort(first)]


def half_face(m: Measurements) -> HalfFace:
    """Lay out the left half of the face from its measurements."""
    middle = _midline(m)
    eye, mouth, nose = _eye(m), _mouth(m, middle), _nose(m, middle)
    curves = {"midline": np.array(list(middle.values())), "outline": _outline(m, middle)}
    # Between sparse points the spline would let creases fade and swell.
    curves |= {name: _dense(curve) for name, curve in (eye.curves | mouth.curves).items()} | nose.curves
    return HalfFace(curves, np.concatenate([eye.fill, mouth.fill, nose.fill, _section_fill(m)]))


def _dense(curve: FloatArray, step_mm: float = 2.0) -> FloatArray:
    """Return points about `step_mm` apart on a smooth curve through the given ones."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    at = np.linspace(0, arc[-1], round(arc[-1] / step_mm) + 1)
    dense = PchipInterpolator(arc, curve)(at)
    dense[[0, -1]] = curve[[0, -1]]
    return dense


def _xyz(rows: list[tuple[float, float, float]]) -> FloatArray:
    return np.array(rows, float)


def _at(distance: float, origin: tuple[float, float], depth: float) -> float:
    """Return y below `origin` (y, z) such that the straight distance to (y, depth) is `distance`."""
    return origin[0] - float(np.sqrt(distance**2 - (depth - origin[1]) ** 2))


def _midline(m: Measurements) -> dict[str, tuple[float, float, float]]:
    """Return the profile from the hairline to under the chin, by name."""
    sn_z, sto_z, gn_z = 8.2, 4.0, -7.0
    sn, sto = _at(m.nose_height_mm, (0, 0), sn_z), _at(m.upper_face_height_mm, (0, 0), sto_z)
    gn = _at(m.face_height_mm, (0, 0), gn_z)
    prn_z = sn_z + 13.8
    prn = sn + float(np.sqrt(m.nose_protrusion_mm**2 - (prn_z - sn_z) ** 2))
    tr_z = -15.0
    tr = -_at(m.hairline_height_mm, (0, 0), tr_z)
    lip = (sto - sn) / -20.6
    return {
        "tr": (0, tr, tr_z),
        "forehead_high": (0, 0.8 * tr, -8.2),
        "forehead": (0, 0.6 * tr, -4.2),
        "forehead_low": (0, 0.42 * tr, -0.8),
        "glabella": (0, 18.0, 0.6),
        "glabella_low": (0, 9.0, -0.2),
        "n": (0, 0, 0),
        "bridge_high": (0, 0.14 * prn, 2.8),
        "bridge": (0, 0.33 * prn, 7.8),
        "rhinion": (0, 0.56 * prn, 14.0),
        "supratip": (0, 0.81 * prn, 20.0),
        "prn": (0, prn, prn_z),
        "infratip": (0, prn + 0.42 * (sn - prn), prn_z - 2.4),
        "columella": (0, prn + 0.76 * (sn - prn), prn_z - 8.5),
        "sn": (0, sn, sn_z),
        "philtrum": (0, sn - 6.5 * lip, 8.0),
        "ls": (0, sn - 12.6 * lip, 10.0),
        "upper_lip": (0, sn - 16.4 * lip, 10.0),
        "sto": (0, sto, sto_z),
        "lower_lip": (0, sto - 4.6, 8.2),
        "li": (0, sto - 9.0, 6.6),
        "lip_fold": (0, sto - 13.5, 2.6),
        "sl": (0, sto - 18.0, 1.4),
        "chin_high": (0, sto - 24.5, 2.6),
        "pg": (0, sto - 32.0, 3.2),
        "chin_low": (0, sto - 39.0, 0.6),
        "gn": (0, gn, gn_z),
        "under_chin": (0, gn - 3.2, -15.0),
        "throat": (0, gn - 4.6, -24.0),
    }


def _outline(m: Measurements, middle: dict[str, tuple[float, float, float]]) -> FloatArray:
    """Return the boundary from the hairline over the ear's front and under the jaw to the throat."""
    tr, throat = middle["tr"], middle["throat"]
    inner = _xyz(
        [
            (14, tr[1] + 0.6, tr[2] - 1.5), (28, tr[1] - 0.9, tr[2] - 6.5), (40, 58.5, -28), (49, 51, -32.5),
            (56, 41, -35.5), (61, 29, -38.5), (65, 15.5, -46), (68.3, 2, -56), (70.2, -11, -65),
            (71.3, -24, -71), (70.8, -41, -71.5), (68, -59, -70.5), (61.5, -76, -68.5),
            (m.jaw_width_mm / 2, -93.5, -63), (42.5, -107, -52.5), (31, -116.2, -41),
            (16, throat[1] + 1.4, -31),
        ]
    )  # fmt: skip
    return np.concatenate([[tr], inner, [throat]])


def _eye(m: Measurements) -> HalfFace:
    """Return the lid margins from the inner to the outer corner, the eyeball between them, the orbit.

    Rows run from corner to corner; a column holds (share of the eye's width, height in half openings
    above the pupil, depth) for each row.
    """
    en, ex, half = m.inner_eye_width_mm / 2, m.outer_eye_width_mm / 2, m.eye_opening_mm / 2

    def row(columns: list[tuple[float, float, float]]) -> FloatArray:
        return _xyz([(en + share * (ex - en), -3.0 + up * half, depth) for share, up, depth in columns])

    inner, outer = row([(0, -0.52, -15.6)]), row([(1, -0.12, -20.8)])
    upper = row(
        [(0.1, 0.1, -14.2), (0.27, 0.72, -12.4), (0.48, 1, -11.7), (0.7, 0.8, -13.4), (0.87, 0.36, -17.4)]
    )
    lower = row(
        [
            (0.1, -0.78, -14.9),
            (0.27, -0.94, -13.5),
            (0.48, -1, -13.1),
            (0.7, -0.88, -14.6),
            (0.87, -0.58, -17.8),
        ]
    )
    ball = row(
        [(0.1, -0.4, -15), (0.27, -0.1, -12.5), (0.48, 0, -11.4), (0.7, -0.05, -13), (0.87, -0.1, -17.2)]
    )
    fold = row(
        [
            (-0.06, 0.62, -12.6),
            (0.2, 1.45, -11.6),
            (0.48, 1.75, -10.6),
            (0.74, 1.5, -11.8),
            (0.97, 0.75, -17.4),
        ]
    )
    socket = row(
        [(-0.16, 1.7, -7), (0.12, 2.2, -7), (0.46, 2.4, -7.8), (0.78, 2.25, -9.9), (1.1, 1.5, -16.6)]
    )
    under = row(
        [
            (0.02, -1.4, -14.2),
            (0.24, -1.7, -13.2),
            (0.5, -1.75, -13.2),
            (0.76, -1.6, -15.2),
            (0.98, -1.1, -19.4),
        ]
    )
    bag = row([(0.24, -2.5, -11.8), (0.52, -2.55, -12.4), (0.8, -2.4, -14.8), (1.04, -1.9, -19.4)])
    side = row([(1.12, -0.1, -22.2)])
    curves = {
        "upper_lid": np.concatenate([inner, upper, outer]),
        "lower_lid": np.concatenate([inner, lower, outer]),
    }
    return HalfFace(curves, np.concatenate([ball, fold, socket, under, bag, side]))


def _mouth(m: Measurements, middle: dict[str, tuple[float, float, float]]) -> HalfFace:
    """Return vermilion borders and mouth line from the midline to the corner, and the lips between.

    Every row has the same columns (shares of the half width), so that the lips are lofted without
    wrinkles; a column holds (height above the mouth line, depth before it).
    """
    half, sto = m.mouth_width_mm / 2, middle["sto"]
    shares = np.array([0.2, 0.4, 0.6, 0.8])
    line = np.stack([half * shares, sto[1] - 1.4 * shares**2, sto[2] - 10.5 * shares**2.2], 1)
    corner = (half, sto[1] - 1.4, sto[2] - 10.5)

    def row(height: tuple[float, ...], before: tuple[float, ...]) -> FloatArray:
        return line + np.stack([np.zeros(4), np.array(height), np.array(before)], 1)

    top, bottom = middle["ls"][1] - sto[1], middle["li"][1] - sto[1]
    upper_border = row((top + 0.9, top - 0.9, top - 3.0, top - 5.5), (5.9, 5.2, 3.6, 1.8))
    lower_border = row((bottom + 0.2, bottom + 1.1, bottom + 3.0, bottom + 5.6), (2.9, 2.7, 2.0, 1.0))
    upper_lip = row((4.4, 3.9, 2.8, 1.4), (5.8, 4.8, 3.2, 1.4))
    lower_lip = row((-4.4, -3.9, -2.9, -1.7), (4.5, 4.0, 2.6, 1.1))
    above = row((12.2, 11.6, 10.6, 9.4), (5.2, 4.2, 3.6, 3.2))
    below = row((-13.2, -12.4, -10.4, -7.6), (-1.2, -0.8, 0.2, 0.8))
    aside = [
        (29, -69, -4.6),
        (30.5, -75, -7.4),
        (28, -81, -6.4),
        (26.5, -64, -2.4),
        (16.5, -57, 2.4),
        (9.5, -57.4, 6.4),
    ]
    chin = [(9, sto[1] - 18, 0.6), (17.5, sto[1] - 17, -2.2)]
    curves = {
        "upper_vermilion": np.concatenate([[middle["ls"]], upper_border, [corner]]),
        "mouth_line": np.concatenate([[sto], line, [corner]]),
        "lower_vermilion": np.concatenate([[middle["li"]], lower_border, [corner]]),
        "upper_lip": np.concatenate([[middle["upper_lip"]], upper_lip[:3]]),
        "lower_lip": np.concatenate([[middle["lower_lip"]], lower_lip[:3]]),
    }
    return HalfFace(
        curves, np.concatenate([upper_lip[3:], lower_lip[3:], above, below, _xyz(aside), _xyz(chin)])
    )


def _nose(m: Measurements, middle: dict[str, tuple[float, float, float]]) -> HalfFace:
    """Return the crease around the wing, the lower rim from columella to wing, and the nose's surface."""
    wing = m.nose_width_mm / 33
    crease = [
        (13.4, -36.4, 3.4),
        (15.9, -39.6, -0.8),
        (16.9, -44.2, -2.4),
        (15.8, -48.6, -1.2),
        (12.4, -51.2, 1.6),
    ]
    bridge = [
        (5, 2, -2.6), (9.5, 2.5, -7.2), (5, -5, 0), (9.5, -6, -7), (13, -7, -12.2),
        (4.5, -12, 5.8), (8.5, -12.5, -0.8), (12.5, -13.5, -8), (16, -14.5, -11.2),
        (4.5, -20.5, 11.6), (8.5, -21, 5.2), (12.5, -22, -2.4), (16.5, -23, -7.2),
        (4.5, -29, 17.2), (8.8, -29.5, 11.6), (12.8, -30.5, 3.6), (16.8, -31.5, -3.2),
    ]  # fmt: skip
    tip = [
        (5, -35, 20.2), (9, -35.6, 14.2), (12, -36, 7.4), (5.4, -39.6, 20.2), (9.2, -40.6, 15),
        (4.6, -43.6, 18.6),        (8.4, -44.4, 14.8), (10.8, -42.4, 10.6), (10.2, -45.6, 12),
    ]  # fmt: skip
    ala = [
        (12.8, -39.8, 7.4), (14.6, -41.2, 4), (16, -42.6, 1.8), (14.4, -43.8, 6.8), (16.5, -45.4, 1.6),
        (14.8, -46.4, 5.6), (12.6, -45.2, 9.2),
    ]  # fmt: skip
    rim = [
        (3.4, -48.4, 13.2),
        (6.8, -47.6, 12.4),
        (10, -47.2, 10.6),
        (12.6, -47.8, 8),
        (14.4, -48.4, 5),
        (15.3, -49, 1.8),
    ]
    under = [
        (7, -49.4, 10.2), (9.4, -49.4, 7.8), (12, -49.8, 5.2), (3.6, -51.4, 8.8), (9.6, -51.2, 5),
        (6.2, -52.6, 6.8), (10, -53.6, 4.2),
    ]  # fmt: skip
    curves = {
        "alar_crease": _xyz([(x * wing, y, z) for x, y, z in crease]),
        "nose_rim": np.concatenate([[middle["columella"]], _xyz([(x * wing, y, z) for x, y, z in rim])]),
    }
    rows = [*bridge, *((x * wing, y, z) for x, y, z in [*tip, *ala, *under])]
    return HalfFace(curves, _xyz(rows))


def _section_fill(m: Measurements) -> FloatArray:
    """Return horizontal sections: (height, then (x, z) pairs outward)."""
    forehead, cheekbone = m.forehead_width_mm / 2, m.face_width_mm / 2
    sections: list[tuple[float, list[tuple[float, float]]]] = [
        (51, [(12, -8.8), (24, -12), (36, -18.5), (44, -25.5)]),
        (38, [(12, -4.8), (24, -7.5), (36, -13.5), (46, -21.5), (53, -29.2)]),
        (25, [(10, -0.4), (20, -1.8), (30, -4.8), (40, -10.5), (49, -18.8), (forehead, -29.4)]),
        (16, [(8, 0), (16, -1.4), (26, -3.8), (36, -6.8), (44, -10.8), (51, -16.8), (57, -26), (62, -37)]),
        (9, [(7, -1.8), (55, -22.5)]),
        (6, [(60, -32), (65, -44.5)]),
        (-5, [(56, -29), (62, -38.5), (67, -52)]),
        (-16, [(46, -18.8), (54, -25.5), (60.5, -34.5), (65.8, -46.5), (69.6, -60)]),
        (-21, [(22, -9.6), (30, -11.2), (38, -13.4)]),
        (-28, [(22, -7.2), (30, -9.4), (38, -12.4), (46, -16.4), (54, -23.4), (61, -34.2), (cheekbone, -52)]),
        (-38, [(22, -4.6), (30, -7.6), (38, -11), (46, -15.8), (54, -23.4), (61.2, -36), (67, -51)]),
        (-48, [(22, -3.6), (30, -6.8), (38, -10.8), (46, -16.4), (54, -25.2), (61, -38.2), (66, -53.5)]),
        (-60, [(23, -1), (31, -6.4), (39, -12), (47, -19.6), (54, -29.2), (60, -41.6), (64.2, -56)]),
        (-74, [(37, -12.6), (44, -19.6), (50.5, -28.8), (56, -39.6), (60, -50), (62, -59)]),
        (-86, [(27, -7), (34, -12), (41, -20), (47.8, -31), (53, -43), (56, -56)]),
        (-97, [(9, 1.6), (17, -2.4), (25, -8), (33, -16), (40, -26.4), (46, -38.5), (49, -50)]),
        (-107, [(8, 2), (17, -3.2), (25, -11), (32, -21), (38, -33), (41.5, -44)]),
        (-115, [(8, -3.4), (16, -8.2), (24, -16.8), (30, -29)]),
        (-119, [(16, -17.5), (23.5, -30)]),
        (-120.4, [(8, -13.5)]),
    ]  # fmt: skip
    return _xyz([(x, y, z) for y, pairs in sections for x, z in pairs])
