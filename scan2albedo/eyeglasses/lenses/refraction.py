"""Rays through an ideal thin lens of given dioptres (supplement, equations S11 and S12)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.geometry.mesh import normalized

_GRAZING = 1e-9
"""Sine of the angle to the lens plane below which a camera or a ray counts as lying in it."""


@dataclass(frozen=True)
class ThinLens:
    """An ideal thin lens: optical centre, axis and power."""

    center: ArrayLike
    """(3,) mm."""
    normal: ArrayLike
    """(3,) along the optical axis, of any length and either sign: a thin lens has no front."""
    dioptres: float
    """1/m. Positive gathers light and enlarges what is behind it (for the farsighted), negative scatters it
    and makes things smaller (for the shortsighted); 0 is window glass."""


@dataclass(frozen=True)
class RefractedRays:
    """Rays on the far side of a lens."""

    origins: FloatArray
    """(N, 3) mm, in the lens plane."""
    directions: FloatArray
    """(N, 3) unit vectors away from the camera."""


def refract(lens: ThinLens, camera: ArrayLike, points: ArrayLike) -> RefractedRays:
    """Return the rays from `camera` through `points` bent at the plane of a thin lens.

    With p where a ray meets the plane through o, u > 0 the camera's distance from it and P = -D / 1000,

        d' ~ (p - o) (1 + u P) - (c - o).

    This is the ray to the conjugate image of c (Hecht, "Optics", 5th ed., section 5.2.3; equations S11 and
    S12 of Li et al.) times 1 + u P: it holds for P = 0, where it is the ray
    itself, for 1 + u P = 0, where all rays become parallel, and beyond, where the image lies in front.

    Parameters
    ----------
    lens : ThinLens
    camera : (3,) or (N, 3) array_like of float
        Centre of projection, or one origin a ray; mm.
    points : (N, 3) array_like of float
        Where each ray is heading, mm: any point on it but its origin, such as a hit on a lens mesh, which
        need not be flat.

    Raises
    ------
    EyeglassesError
        When numbers are not finite, the normal is zero, a camera lies in the lens plane, or a ray runs
        along the plane or away from it.
    ValueError
        When an array has the wrong shape.

    Notes
    -----
    MEGANE's supplement works with f = 1 / P, infinite for plane glass and positive for what shrinks;
    the sign of the dioptres here is the optician's.

    Examples
    --------
    >>> lens = ThinLens(center=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0], dioptres=2.0)
    >>> rays = refract(lens, [0.0, 0.0, 500.0], [[20.0, 0.0, 0.0]])
    >>> rays.directions.round(9) + 0.0
    array([[ 0.,  0., -1.]])
    """
    center, normal, power = _checked_lens(lens)
    origins, through = np.asarray(camera, np.float64), np.asarray(points, np.float64)
    if through.ndim != 2 or through.shape[1] != 3:
        raise ValueError(f"points must have shape (N, 3), got {through.shape}")
    if origins.shape not in ((3,), through.shape):
        raise ValueError(f"camera must have shape (3,) or {through.shape}, got {origins.shape}")
    for name, values in (("camera", origins), ("points", through)):
        if not np.isfinite(values).all():
            raise EyeglassesError(f"{name} holds numbers that are not finite; leave such rays out")
    from_center = np.broadcast_to(origins - center, through.shape)
    height = from_center @ normal
    _check_cameras(from_center, height)
    heading = normalized(through - origins)
    approach = -np.sign(height) * (heading @ normal)
    astray = np.flatnonzero(approach <= _GRAZING)
    if len(astray):
        raise EyeglassesError(
            f"{len(astray)} of {len(through)} rays (the first: {astray[0]}) never reach the lens plane from "
            "the camera's side; refract only rays that hit the lens"
        )
    u = np.abs(height)
    offset = from_center + heading * (u / approach)[:, None]
    bent = offset * (1 + u * power)[:, None] - from_center
    return RefractedRays(center + offset, normalized(bent))


def _checked_lens(lens: ThinLens) -> tuple[FloatArray, FloatArray, float]:
    """Return the centre, the unit normal and P per mm: a tuple of three for the one caller."""
    center, normal = np.asarray(lens.center, np.float64), np.asarray(lens.normal, np.float64)
    for name, values in (("center", center), ("normal", normal)):
        if values.shape != (3,):
            raise ValueError(f"the lens's {name} must have shape (3,), got {values.shape}")
    if not (np.isfinite(center).all() and np.isfinite(normal).all() and np.isfinite(lens.dioptres)):
        raise EyeglassesError(f"the lens holds numbers that are not finite: {lens}; plane glass has 0 D")
    length = float(np.linalg.norm(normal))
    if length == 0:
        raise EyeglassesError("the lens's normal is zero; give the direction of its optical axis")
    return center, normal / length, -float(lens.dioptres) / 1000


def _check_cameras(from_center: FloatArray, height: FloatArray) -> None:
    """Raise for cameras in the lens plane, where the thin lens has no image."""
    flat = np.abs(height) <= _GRAZING * np.linalg.norm(from_center, axis=1)
    if flat.any():
        raise EyeglassesError(
            "the camera lies in the plane of the lens, which shows it nothing; move the camera, or leave "
            f"this lens out of the picture ({int(flat.sum())} of {len(flat)} rays)"
        )
