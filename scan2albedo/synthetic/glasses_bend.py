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
    """How far each temple's tip moves outward; both temples bend like beams held at the hinge."""
    bridge_deg: float = 0.0
    """How far each half of the front turns around the bridge; positive wraps it tighter around the face."""
    twist_deg: float = 0.0
    """Turns the left half around the x-axis against the right one, as by sitting on the frame."""


def bend_points(
    points: FloatArray, bend: GlassesBend, hinge_z: float, temple_depth: float, bridge_width: float
) -> FloatArray:
    """Return points (..., 3) moved by the bend.

    A temple's section at depth z moves outward by s u^2 (3 - u) / 2, u = (hinge_z - z) / temple_depth: a
    cantilever loaded at its end. The front's middle line turns by phi(x) about y, which rises within the
    bridge as a sine; what lies off the line keeps its distance. Volumes change to second order only.
    """
    if bend == GlassesBend():
        return np.array(points, np.float64)
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    u = np.clip((hinge_z - z) / temple_depth, 0, None)
    x = x + np.sign(x) * bend.temple_spread_mm * u**2 * (3 - u) / 2
    turn = _rise(x, bridge_width) * np.deg2rad(bend.twist_deg) / 2
    y, z = np.cos(turn) * y - np.sin(turn) * z, np.sin(turn) * y + np.cos(turn) * z
    reach = np.linspace(0, max(float(np.abs(x).max(initial=1.0)), 1.0), _DENSE)
    angle = np.deg2rad(bend.bridge_deg) * _rise(reach, bridge_width)
    step = reach[1]
    lines = [
        np.concatenate([[0.0], np.cumsum(step * (f[1:] + f[:-1]) / 2)])
        for f in (np.cos(angle), np.sin(angle))
    ]
    forward, back = (np.interp(np.abs(x), reach, line) for line in lines)
    phi = np.deg2rad(bend.bridge_deg) * _rise(np.abs(x), bridge_width)
    return np.stack([np.sign(x) * (forward + z * np.sin(phi)), y, z * np.cos(phi) - back], -1)


def _rise(x: FloatArray, bridge_width: float) -> FloatArray:
    """Return a smooth step from -1 to 1 across the bridge."""
    return np.sin(np.pi / 2 * np.clip(2 * x / bridge_width, -1, 1))
