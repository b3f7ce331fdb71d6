"""Eyes, mouth and nose: spheres, ellipsoids and arcs that stand before the face's sections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from face_model_generator.anthropometry import Measurements
from face_model_generator.sections import Midline, Offset, Sections
from scan2albedo.core.arrays import FloatArray

PUPIL_HEIGHT_MM = -3.0
"""Of the pupil over the nasion."""
LID_MARGIN_MM, LID_MM = 1.5, 2.5
"""Thickness of the lids over the eyeball at their margins and further off."""
INNER_CORNER_MM = 5.0
"""Depth of the inner eye corner behind the corneal plane; artist's judgement."""


def smooth_max(a: ArrayLike, b: ArrayLike, rounding: float) -> FloatArray:
    """Return the larger of two depths, rounded by `rounding` mm where they meet.

    >>> float(smooth_max(3.0, 3.0, 1.0))
    3.5
    """
    first, second = np.asarray(a, float), np.asarray(b, float)
    return 0.5 * (first + second + np.sqrt((first - second) ** 2 + rounding**2))


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid with semi-axes along the frame's axes."""

    center: tuple[float, float, float]
    axes: tuple[float, float, float]

    def front(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return z of the front at x and y; outside its outline, steeply behind the center."""
        u = (np.asarray(x, float) - self.center[0]) / self.axes[0]
        v = (np.asarray(y, float) - self.center[1]) / self.axes[1]
        left = 1 - u**2 - v**2
        return self.center[2] + self.axes[2] * np.where(left > 0, np.sqrt(np.abs(left)), 3 * left)


@dataclass(frozen=True)
class Eye:
    """An eyeball, its corners, and the lids over it.

    Parameters
    ----------
    ball : Ellipsoid
        A sphere of published radius, as far behind the nasion as cornea and nasion tell.
    inner, outer : (3,) float64
        The corners: the outer at its published distance to the tragion.
    """

    ball: Ellipsoid
    inner: FloatArray
    outer: FloatArray
    sections: Sections

    @classmethod
    def of(cls, m: Measurements, ear: FloatArray, sections: Sections) -> Eye:
        """Place the ball behind the cornea, the corners by their widths and the outer one's distance."""
        radius, half = m.eyeball_radius_mm, 0.5 * m.eye_opening_mm
        pole = -m.nasion_before_cornea_mm - m.cornea_mm
        ball = Ellipsoid((0.5 * m.pupil_distance_mm, PUPIL_HEIGHT_MM, pole - radius), (radius,) * 3)
        en, ex = 0.5 * m.inner_eye_width_mm, 0.5 * m.outer_eye_width_mm
        low, high = PUPIL_HEIGHT_MM - 0.52 * half, PUPIL_HEIGHT_MM - 0.12 * half
        away = m.eye_corner_to_ear_mm**2 - (ex - ear[0]) ** 2 - (high - ear[1]) ** 2
        inner = np.array([en, low, -m.nasion_before_cornea_mm - INNER_CORNER_MM])
        return cls(ball, inner, np.array([ex, high, ear[2] + np.sqrt(away)]), sections)

    def cover(self, x: FloatArray, y: FloatArray, thickness_mm: float) -> FloatArray:
        """Return z of skin of a thickness over the ball, joined to the line between the corners."""
        grown = Ellipsoid(self.ball.center, (self.ball.axes[0] + thickness_mm,) * 3)
        line = np.interp(x, [self.inner[0], self.outer[0]], [self.inner[2], self.outer[2]])
        return smooth_max(grown.front(x, y), line, 1.0)

    def lid(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return z of the lids' outer skin, which runs into the orbit's."""
        grown = Ellipsoid(self.ball.center, (self.ball.axes[0] + LID_MM,) * 3)
        return smooth_max(grown.front(x, y), self.sections.depth(x, y), 1.0)


@dataclass(frozen=True)
class Nose:
    """A pyramid with a rounded ridge, an ellipsoidal tip and ellipsoidal wings.

    Parameters
    ----------
    ridge : PchipInterpolator
        Depth of the midline over the height.
    half_width : PchipInterpolator
        Of the pyramid's base over the height.
    tip, wing : Ellipsoid
    columella, subnasale : tuple of float
        Points of the midline.
    """

    ridge: PchipInterpolator
    half_width: PchipInterpolator
    tip: Ellipsoid
    wing: Ellipsoid
    columella: tuple[float, float, float]
    subnasale: tuple[float, float, float]
    sections: Sections

    @classmethod
    def of(cls, m: Measurements, middle: Midline, sections: Sections) -> Nose:
        """Set ridge and tip on the midline's profile, the wings at the nose's width."""
        names = ("sn", "columella", "infratip", "prn", "supratip", "rhinion", "bridge", "bridge_high", "n",
                 "glabella_low", "glabella")  # fmt: skip
        y, z = np.array([middle[name][1:] for name in names]).T
        prn, half = middle["prn"], 0.5 * m.nose_width_mm
        base = float(sections.depth(half + 0.5, middle["prn"][1] - 4.0))
        widths = PchipInterpolator(
            [middle["sn"][1], prn[1], 0.45 * prn[1], 0.0, middle["glabella"][1]],
            [half - 1.0, half - 0.5, 0.8 * half, 0.6 * half, 0.9 * half],
        )
        wing = Ellipsoid((half - WING_AXES_MM[0], prn[1] - 3.5, base + 0.5 * WING_AXES_MM[2]), WING_AXES_MM)
        tip = Ellipsoid((0.0, prn[1], prn[2] - TIP_AXES_MM[2]), TIP_AXES_MM)
        return cls(PchipInterpolator(y, z), widths, tip, wing, middle["columella"], middle["sn"], sections)

    def depth(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return z of the nose's skin, or of the face beside it."""
        across, height = np.asarray(x, float), np.asarray(y, float)
        beside = across >= self.half_width(height)
        wall = np.where(beside, self.sections.depth(across, height), self._side(across, height))
        tipped = smooth_max(wall, self.tip.front(across, height), 2.0)
        return smooth_max(tipped, self.wing.front(across, height), 2.0)

    def _side(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return z of the pyramid, level with its foot outside."""
        half = self.half_width(y)
        base, top = self.sections.depth(half, y), self.ridge(y)
        return base + (top - base) * (1 - np.minimum(x / half, 1.0) ** RIDGE_EXPONENT)

    def crease(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return z of the crease around the wing: from the nose's side down to the cheek."""
        wing_y = self.wing.center[1]
        share = np.clip((y - wing_y) / self.wing.axes[1], 0, 1)
        return (1 - share) * self.sections.depth(x, y) + share * self._side(x, y)

    def rim(self, x: FloatArray) -> FloatArray:
        """Return z of the nostril's rim: a quarter of an ellipse from the columella to the crease."""
        half = self.wing.center[0] + self.wing.axes[0]
        front, back = self.columella[2] + 2.0, float(self.sections.depth(half, self.columella[1]))
        return back + (front - back) * np.sqrt(1 - np.minimum(x / half, 1.0) ** 2)

    def base(self, x: FloatArray, y: FloatArray, rim_y: FloatArray) -> FloatArray:
        """Return z under the nose: from the rim (at height `rim_y`) hollow back to the lip."""
        lip = self.subnasale[1] - 1.5
        share = np.sqrt(np.clip((rim_y - y) / (rim_y - lip), 0, 1))
        level = (1 - share) * self.rim(x) + share * self.sections.depth(x, np.full_like(x, lip))
        return level + NOSTRIL(x, y)


NOSTRIL = Offset((7.3, -50.0), (3.5, 2.0), -3.0)
"""Hollow of a nostril; artist's judgement."""
TIP_AXES_MM = (9.5, 8.5, 9.0)
"""Semi-axes of the nose's tip; artist's judgement."""
WING_AXES_MM = (6.0, 7.0, 12.0)
"""Semi-axes of a wing of the nose; artist's judgement."""
RIDGE_EXPONENT = 1.6
"""Of the nose's horizontal section: 1 a sharp ridge, 2 a round one; artist's judgement."""


def arch_drop(m: Measurements, x: ArrayLike) -> FloatArray:
    """Return how far the lips fall back from the midline to x, mm.

    The upper dental arch is taken as half an ellipse of published width and depth, grown by the lips'
    thickness.
    """
    across, depth = 0.5 * m.arch_width_mm + m.lip_thickness_mm, m.arch_depth_mm + m.lip_thickness_mm
    return depth * (1 - np.sqrt(1 - (np.asarray(x, float) / across) ** 2))
