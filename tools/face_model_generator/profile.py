"""The midline's profile and the ear's place, from published depths and angles.

Frame: origin at the nasion, +x the subject's left, +y up, +z forward; horizontal is the Frankfort plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from face_model_generator.anthropometry import Measurements
from scan2albedo.core.arrays import FloatArray

GLABELLA_HEIGHT_MM = 16.0
"""Height of the glabella above the nasion: between the brows' heads."""
TIP_RISE_MM = 10.0
"""About the height of the tip over the subnasale, for the little depth that the lean adds to it."""
CHIN_BELOW_MOUTH_MM = 32.0
"""Height of the mouth line above the pogonion."""
CHIN_RADIUS_MM = 16.0
"""Radius of the chin's ball in profile; artist's judgement."""
LIP_ROLL_MM = 3.8
"""Depth of the mouth line behind the upper lip's front: each lip half round; artist's judgement."""


@dataclass(frozen=True)
class Plumb:
    """Depths published in natural head position, brought to the design frame.

    Parameters
    ----------
    subnasale_z_mm : float
        Depth of the subnasale before the nasion in natural head position.
    lean : float
        Depth lost per millimetre downward: natural head position is turned by a few degrees.
    """

    subnasale_z_mm: float
    lean: float

    @classmethod
    def of(cls, m: Measurements) -> Plumb:
        """Solve the nasofrontal angle for the nasion's depth, the facial angle for the lean.

        With g a height ``a`` above n and prn ``b`` below it, both ahead of n, the angle at n is
        ``pi - atan((z_g - z_n) / a) - atan((z_prn - z_n) / b)``, which decreases as n moves back.
        """
        rise = np.sqrt(m.nose_protrusion_mm**2 - m.tip_mm**2)
        drop = m.nose_height_mm - rise
        low, high = m.glabella_mm - 30.0, m.glabella_mm
        for _ in range(60):
            n = 0.5 * (low + high)
            turn = np.arctan((m.glabella_mm - n) / GLABELLA_HEIGHT_MM) + np.arctan((m.tip_mm - n) / drop)
            low, high = (n, high) if np.pi - turn < np.radians(m.nasofrontal_angle_deg) else (low, n)
        to_chin = m.upper_face_height_mm + CHIN_BELOW_MOUTH_MM
        ahead = to_chin * np.tan(np.radians(m.facial_angle_deg - 90.0))
        return cls(-n, float((m.chin_mm - n - ahead) / to_chin))

    def depth(self, published_mm: float, y: float) -> float:
        """Return z of a point at height y whose depth before the true vertical line is published."""
        return self.subnasale_z_mm + published_mm + self.lean * y


def midline(m: Measurements) -> dict[str, tuple[float, float, float]]:
    """Return the profile from the hairline to under the chin, by name."""
    plumb = Plumb.of(m)
    heights = _heights(m, plumb)
    depths = {name: plumb.depth(published, heights[name]) for name, published in _published(m).items()}
    depths |= _forehead(m, heights, depths["glabella"])
    depths |= _nose(m, heights, depths)
    depths |= _chin(heights, depths)
    return {name: (0.0, y, depths[name]) for name, y in heights.items()}


def _heights(m: Measurements, plumb: Plumb) -> dict[str, float]:
    """Return y by name: straight distances of the measurements, even spacing between."""
    sn = _below(m.nose_height_mm, plumb, 0.0)
    sto = _below(m.upper_face_height_mm, plumb, m.upper_lip_mm - LIP_ROLL_MM)
    gn = _below(m.face_height_mm, plumb, m.chin_mm - 8.0)
    ahead = m.tip_mm + plumb.lean * TIP_RISE_MM
    prn = sn + float(np.sqrt(m.nose_protrusion_mm**2 - ahead**2))
    tr, lip = 0.975 * m.hairline_height_mm, (sn - sto) / 20.6
    return {
        "tr": tr, "forehead_high": 0.8 * tr, "forehead": 0.6 * tr, "forehead_low": 0.42 * tr,
        "glabella": GLABELLA_HEIGHT_MM, "glabella_low": 8.0, "n": 0.0, "bridge_high": 0.14 * prn,
        "bridge": 0.33 * prn, "rhinion": 0.56 * prn, "supratip": 0.81 * prn, "prn": prn,
        "infratip": prn + 0.42 * (sn - prn), "columella": prn + 0.76 * (sn - prn), "sn": sn,
        "philtrum": sn - 6.5 * lip, "ls": sn - 12.6 * lip, "upper_lip": sn - 16.4 * lip, "sto": sto,
        "lower_lip": sto - 4.6, "li": sto - 9.0, "lip_fold": sto - 13.5, "sl": sto - 18.0,
        "chin_high": sto - 24.5, "pg": sto - CHIN_BELOW_MOUTH_MM, "chin_low": sto - 39.0, "gn": gn,
        "under_chin": gn - 3.2, "throat": gn - 4.6,
    }  # fmt: skip


def _below(distance: float, plumb: Plumb, published_mm: float) -> float:
    """Return y of a point whose straight distance to the nasion and published depth are given."""
    y = -distance
    for _ in range(20):
        y = -float(np.sqrt(distance**2 - plumb.depth(published_mm, y) ** 2))
    return y


def _published(m: Measurements) -> dict[str, float]:
    """Return depths before the true vertical line; borders of the lips lie just behind their fronts."""
    return {
        "glabella": m.glabella_mm,
        "prn": m.tip_mm,
        "sn": 0.0,
        "philtrum": m.upper_lip_pit_mm + 0.4,
        "ls": m.upper_lip_mm - 0.9,
        "upper_lip": m.upper_lip_mm,
        "sto": m.upper_lip_mm - LIP_ROLL_MM,
        "lower_lip": m.lower_lip_mm,
        "li": m.lower_lip_mm - 1.4,
        "lip_fold": m.lip_chin_fold_mm + 1.4,
        "sl": m.lip_chin_fold_mm,
        "pg": m.chin_mm,
    }


def _forehead(m: Measurements, y: dict[str, float], glabella_z: float) -> dict[str, float]:
    """Return depths on the head's profile through the glabella: half an ellipse over the nasion's level.

    Its semi-axes are half the head's length and the height from the nasion to the vertex.
    """

    def back(height: float) -> float:
        return 0.5 * m.head_length_mm * (1 - float(np.sqrt(1 - (height / m.head_height_mm) ** 2)))

    names = ("forehead_low", "forehead", "forehead_high", "tr")
    return {name: glabella_z + back(y["glabella"]) - back(y[name]) for name in names}


def _nose(m: Measurements, y: dict[str, float], z: dict[str, float]) -> dict[str, float]:
    """Return the hollow at the nasion, a straight bridge into the tip's round, and the columella.

    The columella meets the upper lip at the nasolabial angle; the lip leans by its own depths.
    """
    lip = np.arctan2(z["ls"] - z["sn"], y["sn"] - y["ls"])
    rise = np.tan(np.radians(m.nasolabial_angle_deg) + lip - np.pi / 2)
    slope = z["prn"] / y["prn"]
    rows = {name: slope * y[name] for name in ("bridge_high", "bridge", "rhinion", "supratip")}
    # The bridge leaves the nasion tangent to its hollow, and the tip stands a little before the bridge.
    rows["bridge_high"] -= 0.6
    rows["bridge"] -= 0.6
    rows["rhinion"] += 0.2
    along = {name: z["sn"] + (y[name] - y["sn"]) / rise for name in ("columella", "infratip")}
    rows["columella"] = along["columella"]
    rows["infratip"] = min(along["infratip"], z["prn"] - 2.0)
    return rows | {"n": 0.0, "glabella_low": 0.45 * z["glabella"]}


def _chin(y: dict[str, float], z: dict[str, float]) -> dict[str, float]:
    """Return the chin's ball below the pogonion, the hollow's flank above it, and the floor behind it."""

    def ball(name: str) -> float:
        down = min((y["pg"] - y[name]) / CHIN_RADIUS_MM, 1.0)
        return z["pg"] - CHIN_RADIUS_MM * (1 - float(np.sqrt(1 - down**2)))

    gn = ball("gn")
    return {
        "chin_high": 0.35 * z["sl"] + 0.65 * z["pg"],
        "chin_low": ball("chin_low"),
        "gn": gn,
        "under_chin": gn - 9.0,
        "throat": gn - 18.0,
    }


def tragion(m: Measurements, middle: dict[str, tuple[float, float, float]]) -> FloatArray:
    """Return (3,) the left tragion: least squares of its distances to n, sn and gn.

    With x known, differences of the squared distances to n (the origin) are linear in y and z.
    """
    distances = [m.upper_face_depth_mm, m.middle_face_depth_mm, m.lower_face_depth_mm]
    inward = np.array(distances) ** 2 - 0.25 * m.ear_width_mm**2
    to = np.array([middle[name][1:] for name in ("sn", "gn")])
    y = np.linalg.solve(2 * to, inward[0] - inward[1:] + np.sum(to**2, axis=1))[0]
    # The linear pair fixes the height well; the depth follows from the distance to the nasion.
    return np.array([0.5 * m.ear_width_mm, y, -float(np.sqrt(inward[0] - y**2))])


def gonion(m: Measurements, ear: FloatArray, chin: FloatArray) -> FloatArray:
    """Return (3,) the left gonion: below the tragion, behind the gnathion, at half the jaw's width."""
    x = 0.5 * m.jaw_width_mm
    low = ear[1] - np.sqrt(m.jaw_height_mm**2 - (ear[0] - x) ** 2)
    back = chin[2] - np.sqrt(m.jaw_length_mm**2 - x**2 - (low - chin[1]) ** 2)
    return np.array([x, low, back])
