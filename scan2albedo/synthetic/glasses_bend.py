"""A known smooth deformation of a frame: temples spread like cantilevers, the bridge bent like a beam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_DENSE = 4001


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
    """Return points (..., 3) moved by the bend.

    A temple's section at a way t from the hinge turns outward by theta(t), tan theta the slope of a
    cantilever loaded at its end, s u^2 (3 - u) / 2 with u = t / temple_depth; the front's middle line turns
    by phi(x) about y, which rises within the bridge as a sine. Both lines keep their lengths and what lies
    off them its distance, as thin rods do; volumes change to second order only.

    Parameters
    ----------
    points : (..., 3) float64
    bend : GlassesBend
    hinge : (3,) float64
        Where the left temple begins.
    temple_depth : float
        How far back the temples reach.
    bridge_width : float
    """
    if bend == GlassesBend():
        return np.array(points, np.float64)
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    x, z = _spread(x, z, bend.temple_spread_mm, hinge, temple_depth)
    turn = _rise(x, bridge_width) * np.deg2rad(bend.twist_deg) / 2
    y, z = np.cos(turn) * y - np.sin(turn) * z, np.sin(turn) * y + np.cos(turn) * z
    reach = np.linspace(0, max(float(np.abs(x).max(initial=1.0)), 1.0), _DENSE)
    forward, back = (
        np.interp(np.abs(x), reach, line)
        for line in _line(np.deg2rad(bend.bridge_deg) * _rise(reach, bridge_width), reach[1])
    )
    phi = np.deg2rad(bend.bridge_deg) * _rise(np.abs(x), bridge_width)
    return np.stack([np.sign(x) * (forward + z * np.sin(phi)), y, z * np.cos(phi) - back], -1)


def _spread(
    x: FloatArray, z: FloatArray, spread_mm: float, hinge: FloatArray, depth: float
) -> tuple[FloatArray, FloatArray]:
    """Return x and z (...) with the temples bent outward from the hinges on."""
    way = np.clip(hinge[2] - z, 0, None)
    reach = np.linspace(0, max(float(way.max(initial=1.0)), 1.0), _DENSE)
    u = reach / depth
    angle = np.arctan(spread_mm / depth * (3 * u - 1.5 * u**2))
    along, out = (np.interp(way, reach, line) for line in _line(angle, reach[1]))
    theta, off = np.interp(way, reach, angle), np.abs(x) - hinge[0]
    bent = way > 0
    return (
        np.where(bent, np.sign(x) * (hinge[0] + out + off * np.cos(theta)), x),
        np.where(bent, hinge[2] - along + off * np.sin(theta), z),
    )


def _line(angle: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return how far lines (N,) that turn by an angle at each step have come, straight on and across."""
    parts = [
        np.concatenate([[0.0], np.cumsum(step * (f[1:] + f[:-1]) / 2)])
        for f in (np.cos(angle), np.sin(angle))
    ]
    return parts[0], parts[1]


def _rise(x: FloatArray, bridge_width: float) -> FloatArray:
    """Return a smooth step from -1 to 1 across the bridge."""
    return np.sin(np.pi / 2 * np.clip(2 * x / bridge_width, -1, 1))
