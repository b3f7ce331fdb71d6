"""What a lens is made of and adds to the picture: its tint and the surroundings it mirrors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.geometry.mesh import normalized

_ROUNDING = 1e-12


def map_places(directions: FloatArray) -> FloatArray:
    """Return (N, 2) column and row in [0, 1], by the map's size, of nonzero directions (N, 3).

    Rows run from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x.
    """
    x, y, z = directions.T
    # The angle from +y by its tangent: a cosine near 1 hardly changes with it.
    polar = np.arctan2(np.sqrt(x * x + z * z), y)
    return np.stack([np.arctan2(x, z) / (2 * np.pi) + 0.5, polar / np.pi], 1)


def radiance_at(environment: FloatArray, places: FloatArray) -> FloatArray:
    """Return (N, 3) radiance of a map (H, W, 3) at places (N, 2), bilinear; it is linear in the map."""
    return np.asarray(_radiance(np.ascontiguousarray(environment, np.float64), places))


@njit(cache=True, nogil=True)
def _radiance(environment, places):  # type: ignore[no-untyped-def]
    height, width = environment.shape[:2]
    result = np.empty((places.shape[0], 3))
    for i in range(places.shape[0]):
        column = places[i, 0] * width - 0.5
        row = min(max(places[i, 1] * height - 0.5, 0.0), height - 1.0)
        left, top = int(np.floor(column)), int(np.floor(row))
        across, down = column - left, row - top
        below, right = min(top + 1, height - 1), (left + 1) % width
        left %= width
        for c in range(3):
            upper = (1 - across) * environment[top, left, c] + across * environment[top, right, c]
            lower = (1 - across) * environment[below, left, c] + across * environment[below, right, c]
            result[i, c] = (1 - down) * upper + down * lower
    return result


def blend_lens(
    behind_linear: ArrayLike,
    tint_linear: ArrayLike,
    reflected_linear: ArrayLike,
    alpha: ArrayLike,
    beta: ArrayLike,
) -> FloatArray:
    """Return (..., 3) linear colours (1 - alpha - beta) behind + alpha tint + beta reflected.

    The lens of Li et al. (supplement, equations S11 to S15).

    Parameters
    ----------
    behind_linear, tint_linear, reflected_linear : array_like of float, shapes that broadcast to (..., 3)
        What the bent rays see, the glass's own colour, and `environment_radiance` along mirrored rays.
    alpha, beta : array_like of float, shapes that broadcast to (...)
        Shares of tint and reflection.

    Raises
    ------
    EyeglassesError
        When a share is negative or not finite, or alpha + beta is more than 1: the lens would give more light
        than it gets.

    Examples
    --------
    >>> blend_lens([1.0, 1.0, 1.0], [0.0, 0.0, 0.5], [4.0, 4.0, 4.0], 0.5, 0.1)
    array([0.8 , 0.8 , 1.05])
    """
    a, b = np.asarray(alpha, np.float64), np.asarray(beta, np.float64)
    for name, share in (("alpha", a), ("beta", b)):
        if not (share >= 0).all():
            raise EyeglassesError(f"{name} must be 0 or more everywhere; the least is {share.min()}")
    most = float((a + b).max(initial=0.0))
    if not most <= 1 + _ROUNDING:
        raise EyeglassesError(f"alpha + beta must be at most 1, got up to {most:.6g}: lower one of them")
    a, b = a[..., None], b[..., None]
    behind, tint, reflected = (
        np.asarray(c, np.float64) for c in (behind_linear, tint_linear, reflected_linear)
    )
    return np.maximum(1 - a - b, 0.0) * behind + a * tint + b * reflected


def mirror_on_sphere(
    points: ArrayLike, directions: ArrayLike, center: ArrayLike, normal: ArrayLike, radius_mm: float
) -> FloatArray:
    """Return unit directions (N, 3) of rays mirrored by a lens's front, a sphere that touches its plane.

    Parameters
    ----------
    points, directions : (N, 3) array_like of float
        Where rays meet the lens, mm, and where they go, of any length.
    center, normal : (3,) array_like of float
        Of the lens; the normal towards the viewer.
    radius_mm : float
        Of the front, bulging towards the viewer; infinite for a flat one.

    Raises
    ------
    EyeglassesError
        When the radius is not positive.
    """
    if not radius_mm > 0:
        raise EyeglassesError(f"the radius of a lens's front must be positive, got {radius_mm} mm")
    axis, at = normalized(np.asarray(normal, np.float64)), np.asarray(points, np.float64)
    # Divided by the radius, so that a flat front is no special case.
    outward = normalized(axis + (at - np.asarray(center, np.float64)) / radius_mm)
    heading = normalized(np.asarray(directions, np.float64))
    return heading - 2 * np.einsum("ni,ni->n", heading, outward)[:, None] * outward


def environment_radiance(environment_linear: ArrayLike, directions: ArrayLike) -> FloatArray:
    """Return (N, 3) radiance from directions (N, 3), bilinear in an environment map; linear in the map.

    Parameters
    ----------
    environment_linear : (H, W, 3) array_like of float
        Rows from +y down to -y; columns by azimuth from -pi to pi, from +z toward +x.
    directions : (N, 3) array_like of float
        Of any length but zero.

    Raises
    ------
    ValueError
        When the map has another shape.
    """
    image = np.asarray(environment_linear, np.float64)
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"environment_linear must have shape (H, W, 3), got {image.shape}")
    return radiance_at(image, map_places(np.asarray(directions, np.float64)))


def light_by_environment(images_linear: ArrayLike, weights: ArrayLike) -> FloatArray:
    """Return the picture under an environment, the sum over lights k of w_k I_k.

    Parameters
    ----------
    images_linear : (K, ..., 3) array_like of float
        The picture under each light alone.
    weights : (K,) or (K, 3) array_like of float
        Of each light, or of each of its colour channels.

    Raises
    ------
    ValueError
        When there is not one weight an image.
    """
    images, shares = np.asarray(images_linear, np.float64), np.asarray(weights, np.float64)
    if shares.shape not in ((len(images),), (len(images), 3)):
        raise ValueError(f"weights must be ({len(images)},) or ({len(images)}, 3), got {shares.shape}")
    if shares.ndim == 1:
        shares = np.repeat(shares[:, None], 3, 1)
    return np.einsum("k...c,kc->...c", images, shares)


@dataclass(frozen=True)
class LensMaterial:
    """A lens's power, tint and reflection; the default is clear window glass.

    Raises EyeglassesError when a number is out of range or not finite.

    Examples
    --------
    >>> shortsighted = LensMaterial(dioptres=-4.0, beta=0.04, fresnel=True)
    >>> sunglasses = LensMaterial(tint_linear=(0.1, 0.07, 0.03), alpha=0.85, tinting="filter")
    """

    dioptres: float = 0.0
    """1/m, the optician's sign: negative for the shortsighted, 0 is plane."""
    tint_linear: ArrayLike = (0.0, 0.0, 0.0)
    """(3,) linear colour of the glass."""
    alpha: float = 0.0
    """Share of the tint."""
    beta: float = 0.0
    """Share of the reflection; with `fresnel`, at right angles. alpha + beta is at most 1."""
    front_radius_mm: float = 130.0
    """Of the sphere that mirrors; 130 mm is a usual front of 4 D, infinity a flat one."""
    fresnel: bool = False
    """Whether the reflection grows towards glancing angles (Schlick), at the cost of all other shares."""
    tinting: Literal["paint", "filter"] = "paint"
    """`paint` adds the tint as a matte colour, the paper's way; `filter` multiplies the scene behind
    by it, as dyed glass does."""

    def __post_init__(self) -> None:
        tint = np.asarray(self.tint_linear, np.float64)
        if tint.shape != (3,):
            raise ValueError(f"tint_linear must have shape (3,), got {tint.shape}")
        if not (np.isfinite(tint).all() and (tint >= 0).all() and np.isfinite(self.dioptres)):
            raise EyeglassesError(f"a lens needs finite dioptres and a finite tint of 0 or more, got {self}")
        if self.tinting == "filter" and tint.max() > 1:
            raise EyeglassesError(f"a filter passes at most all light: tint_linear is up to {tint.max():g}")
        if self.tinting not in ("paint", "filter"):
            raise ValueError(f"tinting must be 'paint' or 'filter', got {self.tinting!r}")
        if not self.front_radius_mm > 0:
            raise EyeglassesError(f"a lens's front needs a positive radius, got {self.front_radius_mm} mm")
        blend_lens(tint, tint, tint, self.alpha, self.beta)  # checks the shares

    @property
    def clear(self) -> bool:
        """Whether no light is lost on the way through."""
        return self.alpha == 0 and self.beta == 0 and not self.fresnel

    @property
    def transmission(self) -> FloatArray:
        """(3,) share of light that passes at right angles: 1 - alpha - beta, and alpha tint of a filter."""
        passed = np.full(3, max(1 - self.alpha - self.beta, 0.0))
        return passed + self.alpha * np.asarray(self.tint_linear) if self.tinting == "filter" else passed
