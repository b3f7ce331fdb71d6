"""The face without eyes, nose and lips: horizontal superellipses from the midline to ear and jaw."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from face_model_generator.anthropometry import Measurements
from face_model_generator.profile import Plumb, gonion, tragion
from scan2albedo.core.arrays import FloatArray

Midline = dict[str, tuple[float, float, float]]

RIM_HEIGHT_MM, CHEEK_HEIGHT_MM, WING_HEIGHT_MM = -17.0, -30.0, -46.0
"""Heights of the lower orbital rim, of the cheek below the pupil, and of the deepest of the wing's crease."""

_EXPONENTS = (
    # height, p, q
    (60.0, 1.9, 2.0),
    (16.0, 2.5, 2.0),
    (-30.0, 2.4, 2.3),
    (-60.0, 2.3, 2.5),
    (-90.0, 2.2, 2.4),
    (-122.0, 2.0, 1.8),
)
"""Exponents of the sections: flat brow and cheeks, round upper lip, wedge-like chin; artist's judgement."""

_JAW_EXPONENT = 1.9
"""Of the jaw's lower border from gonion to throat, seen from the front; artist's judgement."""


@dataclass(frozen=True)
class Offset:
    """A rounded rise (or hollow) of the skin: a Gaussian at `place` (x, y), `width` (x, y), all mm."""

    place: tuple[float, float]
    width: tuple[float, float]
    height: float

    def __call__(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the rise at x and y; the mirror image's is added, so that the midline stays smooth."""
        v = (y - self.place[1]) / self.width[1]
        across = [np.exp(-0.5 * ((x - side * self.place[0]) / self.width[0]) ** 2) for side in (1, -1)]
        return self.height * (across[0] + across[1]) * np.exp(-0.5 * v**2)


_SCULPTING = (
    Offset((30.0, 16.0), (14.0, 6.0), 1.0),  # brow's ridge
    Offset((31.5, -2.0), (15.0, 9.5), -6.5),  # orbit
    Offset((14.0, -6.0), (5.0, 8.0), -2.5),  # beside the nose's root
    Offset((46.0, -27.0), (13.0, 9.0), 2.0),  # cheekbone
    Offset((60.0, 16.0), (8.0, 13.0), -1.0),  # temple
    Offset((28.0, -74.0), (8.0, 8.0), -3.2),  # corner of the mouth
)
"""Where skin departs from the closed form; artist's judgement."""


@dataclass(frozen=True)
class Sections:
    """Horizontal sections ``z(x) = z_0 - D (1 - (1 - (|x| / W)^p)^(1/q))``, plus rounded offsets.

    ``z_0``, ``W``, ``D``, ``p`` and ``q`` are functions of the height y. Above the nasion the sections
    are those of an ellipsoidal head of published width, length and height; toward the ear they reach the
    tragion, then the gonion, both triangulated from published distances; below, the jaw's border.

    Parameters
    ----------
    front : PchipInterpolator
        ``z_0(y)``.
    back : PchipInterpolator
        ``(W, z_0 - D)`` of y, from the nasion's level to the gonion.
    shape : PchipInterpolator
        ``(p, q)`` of y.
    throat : tuple of float
        (y, z) where the jaw's borders meet.
    half_height_mm : float
        From the nasion's level to the vertex.
    offsets : tuple of Offset
    """

    front: PchipInterpolator
    back: PchipInterpolator
    shape: PchipInterpolator
    throat: tuple[float, float]
    half_height_mm: float
    offsets: tuple[Offset, ...] = field(default=_SCULPTING)

    @classmethod
    def of(cls, m: Measurements, middle: Midline) -> Sections:
        """Set the sections up from the measurements and the midline's points (x, y, z) by name."""
        ear = tragion(m, middle)
        jaw = gonion(m, ear, np.array(middle["gn"]))
        top = middle["glabella"][2] - 0.5 * m.head_length_mm
        back = [(*jaw[[0, 2]],), (*ear[[0, 2]],), (0.5 * m.head_width_mm, top)]
        heights, p, q = np.array(_EXPONENTS[::-1]).T
        bare = cls(
            _rising([middle[name][1:] for name in ("throat", "tr")]),
            PchipInterpolator([jaw[1], ear[1], 0.0], np.array(back), extrapolate=False),
            PchipInterpolator(heights, np.stack([p, q], 1)),
            middle["throat"][1:],
            m.head_height_mm,
        )
        return _with_wing(_with_front(bare, m, middle), m, middle)

    def depth(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return z at x and y (same shapes), the wings of the nose and the lips taken away."""
        across, height = np.abs(np.asarray(x, float)), np.asarray(y, float)
        raised = sum((offset(across, height) for offset in self.offsets), np.zeros(across.shape))
        return self.front(self._within(height)) - self.drop(across, height) + raised

    def drop(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return how far the closed form falls back from the midline to x."""
        across, height = np.abs(np.asarray(x, float)), np.asarray(y, float)
        width, depth, p, q = self._parameters(height)
        inside = np.clip(1 - (across / width) ** p, 0, 1)
        return depth * (1 - inside ** (1 / q))

    def width(self, y: ArrayLike, z: ArrayLike) -> FloatArray:
        """Return x at which the closed form, offsets left out, reaches z at height y."""
        height = np.asarray(y, float)
        width, depth, p, q = self._parameters(height)
        left = np.clip(1 - (self.front(self._within(height)) - np.asarray(z, float)) / depth, 0, 1)
        return width * np.clip(1 - left**q, 0, 1) ** (1 / p)

    def _within(self, y: FloatArray) -> FloatArray:
        return np.clip(y, self.front.x[0], self.front.x[-1])

    def _parameters(self, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return (W, D, p, q) at heights y."""
        low, high = self.back.x[0], self.back.x[-1]
        half_width, behind = np.moveaxis(self.back(np.clip(y, low, high)), -1, 0)
        up = np.clip((y - high) / self.half_height_mm, 0, 0.99)
        down = np.clip((low - y) / (low - self.throat[0]), 0, 0.995)
        jaw = (1 - down**_JAW_EXPONENT) ** (1 / _JAW_EXPONENT)
        behind = np.where(y < low, self.throat[1] + (behind - self.throat[1]) * jaw**1.5, behind)
        depth = self.front(self._within(y)) - behind
        p, q = np.moveaxis(self.shape(np.clip(y, self.shape.x[0], self.shape.x[-1])), -1, 0)
        return half_width * np.sqrt(1 - up**2) * jaw, depth, p, q


def _rising(points: list[tuple[float, float]]) -> PchipInterpolator:
    y, z = np.array(sorted(points)).T
    return PchipInterpolator(y, z)


def _with_front(bare: Sections, m: Measurements, middle: Midline) -> Sections:
    """Return sections whose middle is the profile, and between brow and lip the published cheek.

    Below the eye the depth at the pupil is known; the section's middle lies its drop ahead of it.
    """
    plumb, pupil = Plumb.of(m), 0.5 * m.pupil_distance_mm
    names = ("tr", "forehead_high", "forehead", "forehead_low", "glabella", "philtrum", "lip_fold", "sl",
             "chin_high", "pg", "chin_low", "gn", "under_chin", "throat")  # fmt: skip
    points = [middle[name][1:] for name in names]
    for height, published in ((RIM_HEIGHT_MM, m.orbital_rim_mm), (CHEEK_HEIGHT_MM, m.under_pupil_mm)):
        there = plumb.depth(published, height)
        points.append((height, there + float(bare.drop(pupil, height))))
    return replace(bare, front=_rising(points))


def _with_wing(sections: Sections, m: Measurements, middle: Midline) -> Sections:
    """Return sections with the hollow beside the nose's wing as deep as published."""
    place = 0.5 * m.nose_width_mm + 0.5, WING_HEIGHT_MM
    missing = Plumb.of(m).depth(m.wing_base_mm, WING_HEIGHT_MM) - float(sections.depth(*place))
    wing = Offset(place, (5.0, 6.0), missing)
    return replace(sections, offsets=(*sections.offsets, wing))
