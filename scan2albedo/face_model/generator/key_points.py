"""Key points and feature curves of the left half (x >= 0) of an average face.

Frame: origin at the nasion, +x the subject's left, +y up, +z out of the face, millimetres. Widths and
heights follow from `Measurements`; depths, which the literature hardly tabulates, are this table's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    curves = {"midline": np.array(list(middle.values())), "outline": _outline(m, middle)}
    curves |= _eye(m) | _mouth(m, middle) | _nose(m)
    return HalfFace(curves, np.concatenate([_nose_fill(m), _orbit_fill(), _section_fill(), _mouth_fill()]))


def _xyz(rows: list[tuple[float, float, float]]) -> FloatArray:
    return np.array(rows, float)


def _at(distance: float, origin: tuple[float, float], depth: float) -> float:
    """Return y below `origin` (y, z) such that the straight distance to (y, depth) is `distance`."""
    return origin[0] - float(np.sqrt(distance**2 - (depth - origin[1]) ** 2))


def _midline(m: Measurements) -> dict[str, tuple[float, float, float]]:
    """Return the profile from the hairline to under the chin, by name."""
    sn_z, sto_z, gn_z = 8.0, 4.0, -7.0
    sn, sto = _at(m.nose_height_mm, (0, 0), sn_z), _at(m.upper_face_height_mm, (0, 0), sto_z)
    gn = _at(m.face_height_mm, (0, 0), gn_z)
    prn_z = sn_z + 14.5
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
        "bridge": (0, 0.33 * prn, 7.6),
        "rhinion": (0, 0.55 * prn, 13.2),
        "supratip": (0, 0.8 * prn, 19.6),
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
            (14, tr[1] + 0.6, tr[2] - 1.5),
            (28, tr[1] - 0.6, tr[2] - 7.5),
            (40, 58, -30),
            (50, 50.5, -37.5),
            (57, 40, -41.5),
            (61, 29, -44),
            (65, 15, -50),
            (68.3, 1, -60),
            (69.8, -11, -67),
            (70.3, -24, -71),
            (69.3, -41, -71),
            (66.3, -59, -70),
            (60, -76, -68.5),
            (m.jaw_width_mm / 2, -90, -63),
            (42, -104, -52.5),
            (31, -114.5, -40.5),
            (16, throat[1] + 2.0, -29),
        ]
    )
    return np.concatenate([[tr], inner, [throat]])


def _eye(m: Measurements) -> dict[str, FloatArray]:
    """Return the lid margins from the inner to the outer corner; between them lies the eyeball."""
    en, ex, half = m.inner_eye_width_mm / 2, m.outer_eye_width_mm / 2, m.eye_opening_mm / 2
    inner, outer = (en, -6.0, -15.5), (ex, -3.5, -22.0)
    across = ex - en

    def lid(offsets: list[tuple[float, float, float]]) -> FloatArray:
        rows = [(en + a * across, -2.6 + b * half, z) for a, b, z in offsets]
        return _xyz([inner, *rows, outer])

    upper = [(0.1, 0.0, -14.2), (0.25, 0.65, -12.6), (0.46, 1.0, -11.9), (0.68, 0.82, -13.5)]
    lower = [(0.14, -0.78, -14.2), (0.35, -0.95, -13.2), (0.57, -1.0, -13.2), (0.78, -0.68, -15.8)]
    return {
        "upper_lid": lid([*upper, (0.86, 0.3, -17.2)]),
        "lower_lid": lid([*lower, (0.91, -0.35, -19.0)]),
    }


def _mouth(m: Measurements, middle: dict[str, tuple[float, float, float]]) -> dict[str, FloatArray]:
    """Return vermilion borders and the mouth line from the midline to the corner."""
    ls, sto, li = middle["ls"], middle["sto"], middle["li"]
    corner = (m.mouth_width_mm / 2, sto[1] - 1.6, -6.5)
    side = m.mouth_width_mm / 52
    upper = [(3.2, 0.5, 9.6), (6.4, 0.9, 8.6), (11.0, -0.8, 6.4), (16.5, -3.2, 3.0), (21.5, -6.0, -1.8)]
    line = [(5.0, -0.4, 3.9), (10.0, -0.4, 2.7), (15.5, -0.5, 0.4), (21.0, -1.0, -3.2)]
    lower = [(5.0, 0.2, 6.1), (10.5, 1.2, 4.4), (16.0, 2.9, 1.2), (21.5, 5.3, -3.0)]
    return {
        "upper_vermilion": _xyz([ls, *((x * side, ls[1] + y, z) for x, y, z in upper), corner]),
        "mouth_line": _xyz([sto, *((x * side, sto[1] + y, z) for x, y, z in line), corner]),
        "lower_vermilion": _xyz([li, *((x * side, li[1] + y, z) for x, y, z in lower), corner]),
    }


def _nose(m: Measurements) -> dict[str, FloatArray]:
    """Return the crease around the wing from its top to the nostril's sill."""
    wing = m.nose_width_mm / 33
    crease = [(13.2, -36.2, 3.4), (16.4, -40.0, -1.4), (17.2, -44.6, -2.4), (15.6, -49.0, -0.8)]
    return {"alar_crease": _xyz([(x * wing, y, z) for x, y, z in [*crease, (11.6, -51.2, 2.2)]])}


def _nose_fill(m: Measurements) -> FloatArray:
    wing = m.nose_width_mm / 33
    bridge = [
        (5, 2, -2.6), (9.5, 2.5, -7.2), (5, -5, 0), (9.5, -6, -7), (13, -7, -12.2),
        (4.5, -12, 5.6), (8.5, -13, -1.2), (12.5, -14, -8.4), (16, -15, -11),
        (5, -21, 10.8), (9, -22, 4), (13, -23, -3.4), (16.5, -24, -7.2),
        (5.5, -29, 16.2), (9.5, -30, 9.4), (13.5, -31, 1.6), (17, -32, -3.6),
    ]  # fmt: skip
    tip = [
        (5.5, -37, 19.6), (9, -38.5, 13.6), (11.5, -38.0, 8.2), (5, -43.5, 18), (8.6, -43, 14.4),
        (13, -41.5, 6.6), (15.4, -42, 3.8), (16.5, -45.6, 2.2), (14.4, -46.5, 6.2), (12, -45.8, 9.4),
        (10.8, -48.6, 8.6), (14, -50, 3.4), (3.2, -47.6, 13.8), (6.8, -48.2, 11.2), (3.4, -51.6, 8.4),
        (8.2, -50.4, 6.2), (6, -52.4, 6.6), (9.6, -52.6, 4.2),
    ]  # fmt: skip
    rows = [*bridge, *((x * wing, y, z) for x, y, z in tip)]
    return _xyz(rows)


def _orbit_fill() -> FloatArray:
    rows = [
        (30, -2.2, -10.6), (24, -3.6, -12.2), (37, -3, -13.4),
        (20, 4.5, -12.6), (27, 6.5, -11.2), (35, 7.2, -11.6), (43, 5.2, -15.2), (48.5, 0.5, -19.6),
        (17, -11.5, -13), (24, -12.5, -13), (32, -13.2, -13), (40, -12.6, -15.4), (47, -9.5, -20),
    ]  # fmt: skip
    return _xyz(rows)


def _section_fill() -> FloatArray:
    """Return horizontal sections: (height, then (x, z) pairs outward)."""
    sections: list[tuple[float, list[tuple[float, float]]]] = [
        (51, [(12, -8.8), (24, -12), (36, -18.5), (46, -28), (53, -36)]),
        (38, [(12, -4.8), (24, -7.5), (36, -13.5), (46, -21.5), (53.5, -30)]),
        (25, [(10, -0.4), (20, -1.8), (30, -4.8), (40, -10.5), (49, -18.8), (56.5, -29), (61, -38.5)]),
        (16, [(8, 0), (16, -1.4), (26, -3.8), (36, -6.8), (44, -10.8), (51, -16.8), (57, -26), (62, -37.5)]),
        (9, [(7, -1.8), (13, -5.8), (19, -7.8), (26, -7.8), (33, -8.2), (41, -11), (48, -15.6), (54, -22)]),
        (7, [(60, -32), (65, -44.5)]),
        (-5, [(50.5, -23.5), (56, -29), (62, -38.5), (67, -52)]),
        (-16, [(46, -18.8), (54, -25.5), (60.5, -34.5), (65.5, -46.5), (68.8, -60)]),
        (-20, [(22, -10), (30, -11.4), (38, -13.6)]),
        (-27, [(22, -7.6), (30, -9.6), (38, -12.6), (46, -16.4), (54, -23.2), (61, -34), (67, -52)]),
        (-37, [(22, -4.8), (30, -7.8), (38, -11.2), (46, -15.8), (54, -23.2), (61, -35.5), (66, -50.5)]),
        (-48, [(22, -3.6), (30, -6.8), (38, -10.8), (46, -16.4), (54, -25.4), (60.5, -38.5), (65, -53.5)]),
        (-60, [(23, -1), (31, -6.4), (39, -12), (47, -19.6), (54, -29.6), (59.5, -42), (63, -56)]),
        (-74, [(33, -9.5), (40, -15), (47, -23.2), (53, -33.5), (57.5, -46), (60, -58)]),
        (-86, [(27, -7), (34, -12), (41, -20), (47.5, -31.5), (52, -44), (54, -56)]),
        (-97, [(9, 1.6), (17, -2.4), (25, -8), (33, -16), (40, -27), (45, -39.5), (47.5, -51)]),
        (-107, [(8, 2), (17, -3.2), (25, -11), (32, -21.5), (38, -35)]),
        (-115, [(8, -3.6), (16, -8.6), (24, -18), (30, -30)]),
        (-120, [(8, -13.5), (16, -20)]),
    ]  # fmt: skip
    return _xyz([(x, y, z) for y, pairs in sections for x, z in pairs])


def _mouth_fill() -> FloatArray:
    rows = [
        (5.2, -58.2, 8.4), (10.5, -58, 6), (16.5, -56.6, 2.4), (16, -62, 3.4), (21, -66.5, -0.4),
        (6.4, -69, 8.8), (12.5, -70, 5.4), (18.5, -72, 0.6), (6, -77.4, 7.4), (12.5, -77.2, 4.6),
        (19, -75.8, -0.6), (26.5, -67.6, -3.8), (28.8, -75, -7.2), (25, -79.6, -5.4), (18.5, -83.2, -1.4),
        (9, -86, 3), (8, -90.5, 0.8), (16.5, -89.5, -2.2),
    ]  # fmt: skip
    return _xyz(rows)
