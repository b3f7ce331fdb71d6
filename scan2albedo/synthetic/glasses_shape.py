"""Measures of a synthetic frame, the curves that follow from them, and a known smooth bend."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.integrate import cumulative_trapezoid

from scan2albedo.core.arrays import FloatArray

RIM_POINTS = 72
CORNER_RINGS = 8
STRAIGHT_RINGS = 34
BEND_RINGS = 10
"""Rings of a temple: around the corner at the hinge, straight back, and down behind the ear."""
_LINE_POINTS = 4001


@dataclass(frozen=True)
class GlassesShape:
    """Measures of a frame; lengths in mm."""

    lens_width: float = 50.0
    lens_height: float = 38.0
    """`lens_width`, `lens_height`: of a lens."""
    squareness: float = 2.6
    """Exponent of the superellipse |x/a|^n + |y/b|^n = 1 of a lens; 2 is an ellipse."""
    bridge_width: float = 18.0
    """Between the rims."""
    bridge_height: float = 5.0
    """Of the bridge's section."""
    rim_width: float = 3.2
    """In the plane of the lens."""
    rim_depth: float = 3.6
    """Along the line of sight."""
    wrap_radius: float = 260.0
    """Radius of the curve that the front follows around the face."""
    temple_length: float = 142.0
    """From hinge to tip, along the temple."""
    temple_spread: float = 3.0
    """How far the temple leans outward where it bends behind the ear."""
    temple_height: float = 5.0
    temple_width: float = 3.0
    """`temple_height`, `temple_width`: of the temple's section."""
    ear_angle_deg: float = 45.0
    """By which the temple bends behind the ear."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Self:
        """Return measures in the range that opticians sell."""
        return cls(
            lens_width=rng.uniform(46, 56),
            lens_height=rng.uniform(32, 46),
            squareness=rng.uniform(2.1, 3.4),
            bridge_width=rng.uniform(15, 22),
            bridge_height=rng.uniform(4.2, 6),
            rim_width=rng.uniform(2.6, 4.5),
            rim_depth=rng.uniform(3, 4.5),
            wrap_radius=rng.uniform(180, 400),
            temple_length=rng.uniform(135, 150),
            temple_spread=rng.uniform(0, 6),
            temple_height=rng.uniform(4, 7),
            temple_width=rng.uniform(2.4, 3.6),
            ear_angle_deg=rng.uniform(35, 50),
        )

    @property
    def lens_center(self) -> FloatArray:
        """(3,) of the left lens, on the front's curve."""
        x = self.bridge_width / 2 + self.rim_width + self.lens_width / 2
        return np.array([x, 0.0, self.depth(np.array(x))])

    def depth(self, x: FloatArray) -> FloatArray:
        """Return z of the front at `x`."""
        return np.asarray(-(x**2) / (2 * self.wrap_radius))


def rim_curve(shape: GlassesShape) -> tuple[FloatArray, FloatArray]:
    """Return the left rim's middle line (72, 3) and its outward normals (72, 3) in the xy-plane.

    Points are equally spaced, counterclockwise seen from the front, and begin at the temple.
    """
    angle = np.linspace(0, 2 * np.pi, 4097)
    half = np.array([shape.lens_width, shape.lens_height]) / 2 + shape.rim_width / 2
    direction = np.stack([np.cos(angle), np.sin(angle)], 1)
    radius = (np.abs(direction / half) ** shape.squareness).sum(1) ** (-1 / shape.squareness)
    outline = radius[:, None] * direction
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    place = np.linspace(0, run[-1], RIM_POINTS, endpoint=False)
    flat = np.stack([np.interp(place, run, outline[:, k]) for k in range(2)], 1)
    slope = np.sign(flat) * np.abs(flat / half) ** (shape.squareness - 1) / half
    normal = np.zeros((RIM_POINTS, 3))
    normal[:, :2] = slope / np.linalg.norm(slope, axis=1)[:, None]
    x = flat[:, 0] + shape.lens_center[0]
    return np.stack([x, flat[:, 1], shape.depth(x)], 1), normal


def temple_path(shape: GlassesShape, start: FloatArray) -> FloatArray:
    """Return the middle line (68, 3) of the left temple from `start` (3,) on the rim to the tip."""
    radius, ear_radius = 6.0, 22.0
    corner = np.linspace(0, np.pi / 2, CORNER_RINGS, endpoint=False)
    around = start + np.stack([radius * np.sin(corner), 0 * corner, radius * (np.cos(corner) - 1)], 1)
    straight_length = 0.66 * shape.temple_length
    u = np.linspace(0, 1, STRAIGHT_RINGS)
    zero = np.zeros(STRAIGHT_RINGS)
    behind = np.stack([shape.temple_spread * u**2, zero, -straight_length * u], 1)
    back = start + [radius, 0, -radius] + behind
    turn = np.linspace(0, np.deg2rad(shape.ear_angle_deg), BEND_RINGS + 1)[1:]
    level = np.array([2 * shape.temple_spread / straight_length, 0, -1.0])
    level /= np.linalg.norm(level)
    down = np.array([0, -1.0, 0])
    bend = back[-1] + ear_radius * (np.sin(turn)[:, None] * level + (1 - np.cos(turn))[:, None] * down)
    rest = shape.temple_length - straight_length - ear_radius * turn[-1]
    heading = np.cos(turn[-1]) * level + np.sin(turn[-1]) * down
    tail = bend[-1] + rest * np.linspace(0, 1, 17)[1:, None] * heading
    return np.concatenate([around, back, bend, tail])


@dataclass(frozen=True)
class GlassesBend:
    """How a frame is bent; zero leaves it alone."""

    temple_spread_mm: float = 0.0
    """How far each temple's tip moves outward, about; both bend like beams held at the hinge."""
    bridge_deg: float = 0.0
    """How far each half of the front turns around the bridge; positive wraps it tighter around the face."""
    twist_deg: float = 0.0
    """Turns the left half around the x-axis against the right one, as by sitting on the frame."""


def bend_points(
    points: FloatArray, bend: GlassesBend, hinge: FloatArray, temple_depth: float, bridge_width: float
) -> FloatArray:
    """Return points (..., 3) moved by the bend; the left temple begins at `hinge` (3,).

    The section of a temple at distance t behind the hinge turns outward by theta(t), where tan theta is the
    slope of a cantilever loaded at its end, s u^2 (3 - u) / 2 with u = t / temple_depth. The front's middle
    line turns by phi(x) about y, which rises within the bridge as a sine. Both lines keep their lengths, and
    points keep their distances from them, as in thin rods; volumes change to second order only.
    """
    if bend == GlassesBend():
        return np.array(points, np.float64)
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    # The temples bend outward from the hinges on.
    way = np.clip(hinge[2] - z, 0, None)
    reach = np.linspace(0, max(float(way.max(initial=1.0)), 1.0), _LINE_POINTS)
    u = reach / temple_depth
    angle = np.arctan(bend.temple_spread_mm / temple_depth * (3 * u - 1.5 * u**2))
    along, out = (np.interp(way, reach, line) for line in _line(angle, reach[1]))
    theta, off, bent = np.interp(way, reach, angle), np.abs(x) - hinge[0], way > 0
    x = np.where(bent, np.sign(x) * (hinge[0] + out + off * np.cos(theta)), x)
    z = np.where(bent, hinge[2] - along + off * np.sin(theta), z)
    turn = _rise(x, bridge_width) * np.deg2rad(bend.twist_deg) / 2
    y, z = np.cos(turn) * y - np.sin(turn) * z, np.sin(turn) * y + np.cos(turn) * z
    reach = np.linspace(0, max(float(np.abs(x).max(initial=1.0)), 1.0), _LINE_POINTS)
    wrap = np.deg2rad(bend.bridge_deg)
    lines = _line(wrap * _rise(reach, bridge_width), reach[1])
    forward, back = (np.interp(np.abs(x), reach, line) for line in lines)
    phi = wrap * _rise(np.abs(x), bridge_width)
    return np.stack([np.sign(x) * (forward + z * np.sin(phi)), y, z * np.cos(phi) - back], -1)


def _line(angle: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return how far lines (N,) that turn by an angle at each step have come, straight on and across."""
    along, across = (cumulative_trapezoid(f, dx=step, initial=0) for f in (np.cos(angle), np.sin(angle)))
    return along, across


def _rise(x: FloatArray, bridge_width: float) -> FloatArray:
    """Return a smooth step from -1 to 1 across the bridge."""
    return np.sin(np.pi / 2 * np.clip(2 * x / bridge_width, -1, 1))
