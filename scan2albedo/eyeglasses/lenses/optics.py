"""What one lens does to a ray: refraction by its power, mirroring by its front, tint and reflection."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scan2albedo.core.arrays import ArrayLike, FloatArray, checked_array, dots, norms
from scan2albedo.errors import EyeglassesError
from scan2albedo.geometry.mesh import normalized

_GRAZING = 1e-9
"""Sine of the angle to the lens plane below which a camera or a ray counts as lying in it."""


@dataclass(frozen=True)
class ThinLens:
    """An ideal thin lens: optical `center` (3,) mm, `normal` (3,) along the axis, of any length and sign."""

    center: ArrayLike
    normal: ArrayLike
    dioptres: float
    """1/m, negative for the shortsighted: things behind the lens look smaller; 0 is window glass."""


@dataclass(frozen=True)
class RefractedRays:
    """Rays beyond a lens: `origins` (N, 3) mm in its plane, unit `directions` (N, 3) from the camera."""

    origins: FloatArray
    directions: FloatArray


def refract(lens: ThinLens, camera: ArrayLike, points: ArrayLike) -> RefractedRays:
    """Return the rays from `camera` through `points` bent at the plane of a thin lens.

    With p where a ray meets the plane through o, u > 0 the camera's distance from it and P = -D / 1000,

        d' ~ (p - o) (1 + u P) - (c - o).

    This is the ray to the conjugate image of c (Hecht, "Optics", 5th ed., section 5.2.3; equations S11 and
    S12 of Li et al., with f = 1 / P) times 1 + u P, so that it holds for P = 0 and 1 + u P = 0 too. Raises
    EyeglassesError when numbers are not finite, the normal is zero, or a camera or ray lies along the lens
    plane; ValueError when an array has the wrong shape.

    Parameters
    ----------
    lens : ThinLens
    camera : (3,) or (N, 3) array_like of float
        Centre of projection, or one origin a ray; mm.
    points : (N, 3) array_like of float
        Where each ray is heading, mm: any point on it but its origin.

    Examples
    --------
    >>> lens = ThinLens(center=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0], dioptres=2.0)
    >>> rays = refract(lens, [0.0, 0.0, 500.0], [[20.0, 0.0, 0.0]])
    >>> rays.directions.round(9) + 0.0
    array([[ 0.,  0., -1.]])
    """
    finite = EyeglassesError
    center = checked_array(lens.center, (3,), "the lens's center", finite=finite)
    normal = checked_array(lens.normal, (3,), "the lens's normal", finite=finite)
    through = checked_array(points, ("N", 3), "points", finite=finite)
    origins = checked_array(camera, (..., 3), "camera", finite=finite)
    if not np.isfinite(lens.dioptres):
        raise EyeglassesError(f"the lens has {lens.dioptres} dioptres, not finite; plane glass has 0")
    if not normal.any():
        raise EyeglassesError("the lens's normal is zero; give the direction of its optical axis")
    normal = normal / np.linalg.norm(normal)
    from_center = np.broadcast_to(origins - center, through.shape)
    height = from_center @ normal
    flat = np.abs(height) <= _GRAZING * norms(from_center)
    if flat.any():
        share = f"{flat.sum()} of {len(flat)} rays"
        raise EyeglassesError(f"the camera lies in the lens plane ({share}); move it, or leave this lens out")
    heading = normalized(through - origins)
    approach = -np.sign(height) * (heading @ normal)
    astray = np.flatnonzero(approach <= _GRAZING)
    if len(astray):
        share = f"{len(astray)} of {len(through)} rays (the first: {astray[0]})"
        raise EyeglassesError(f"{share} never reach the lens plane from the camera's side; leave them out")
    u = np.abs(height)
    offset = from_center + heading * (u / approach)[:, None]
    bent = offset * (1 - u * lens.dioptres / 1000)[:, None] - from_center
    return RefractedRays(center + offset, normalized(bent))


def mirror_on_sphere(
    points: FloatArray, directions: FloatArray, center: ArrayLike, normal: ArrayLike, radius_mm: float
) -> FloatArray:
    """Return unit directions (N, 3) of rays mirrored by a lens's front, a sphere that touches its plane.

    Rays meet the lens at `points` (N, 3) mm; `center` and `normal` (3,) are the lens's, toward the viewer,
    where the front bulges; its radius is infinite for a flat one.
    """
    axis = normalized(np.asarray(normal, float))
    # Divided by the radius, so that a flat front is not a special case.
    outward = normalized(axis + (points - np.asarray(center, float)) / radius_mm)
    heading = normalized(directions)
    return heading - 2 * dots(heading, outward)[:, None] * outward


@dataclass(frozen=True)
class LensMaterial:
    """A lens's power, tint and reflection; the default is clear window glass.

    The colour seen is (1 - alpha - beta) behind + alpha tint + beta reflected, as in Li et al. (supplement,
    equations S11 to S15). Raises EyeglassesError when a number is out of range or not finite.
    """

    dioptres: float = 0.0
    """1/m, the optician's sign: negative for the shortsighted, 0 is plane."""
    tint_linear: ArrayLike = (0.0, 0.0, 0.0)
    alpha: float = 0.0
    beta: float = 0.0
    """Shares of the tint (`alpha`), of colour `tint_linear` (3,), and of the reflection, with `fresnel` at
    right angles; together at most 1."""
    front_radius_mm: float = 130.0
    """Of the sphere that mirrors; 130 mm is a usual front of 4 D, infinity a flat one."""
    fresnel: bool = False
    """Whether the reflection grows towards glancing angles (Schlick), at the cost of all other shares."""
    tinting: Literal["paint", "filter"] = "paint"
    """`paint` adds the tint as a matte colour (the paper's); `filter` multiplies what is behind by it."""

    def __post_init__(self) -> None:
        tint = checked_array(self.tint_linear, (3,), "tint_linear", finite=EyeglassesError)
        if not ((tint >= 0).all() and np.isfinite(self.dioptres)):
            raise EyeglassesError(f"a lens needs finite dioptres and a tint of 0 or more, got {self}")
        if self.tinting == "filter" and tint.max() > 1:
            raise EyeglassesError(f"a filter passes at most all light: tint_linear is up to {tint.max():g}")
        if self.tinting not in ("paint", "filter"):
            raise ValueError(f"tinting must be 'paint' or 'filter', got {self.tinting!r}")
        if not self.front_radius_mm > 0:
            raise EyeglassesError(f"a lens's front needs a positive radius, got {self.front_radius_mm} mm")
        for name in ("alpha", "beta"):
            if not (share := getattr(self, name)) >= 0:
                raise EyeglassesError(f"{name} must be 0 or more, got {share}")
        if not self.alpha + self.beta <= 1 + _GRAZING:
            raise EyeglassesError(f"alpha + beta must be at most 1, got {self.alpha + self.beta:.6g}")

    @property
    def clear(self) -> bool:
        """Whether no light is lost on the way through."""
        return self.alpha == 0 and self.beta == 0 and not self.fresnel

    @property
    def transmission(self) -> FloatArray:
        """(3,) share of light that passes at right angles: 1 - alpha - beta, and alpha tint of a filter."""
        passed = np.full(3, max(1 - self.alpha - self.beta, 0.0))
        return passed + self.alpha * np.asarray(self.tint_linear) if self.tinting == "filter" else passed
