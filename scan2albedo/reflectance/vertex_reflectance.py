"""`VertexReflectance`: how each vertex of a face reflects light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from scan2albedo.core.arrays import ArrayLike, BoolArray, FloatArray, IntArray, checked_array, finite_rows
from scan2albedo.errors import ReflectanceError

EXPONENTS = (1.0, 8.0, 64.0)
"""Of the three Blinn-Phong lobes."""
BLOCK = 128
"""Vertices that are worked on together: their equations fit the first cache."""


@dataclass(frozen=True)
class VertexReflectance:
    """Diffuse albedo and the weights of three Blinn-Phong lobes at V vertices.

    Under a light of unit radiant intensity at unit distance a vertex sends to the camera, where both see it,

        c / pi max(0, n.l) + sum_k w_k (s_k + 2) / (8 pi) max(0, n.h)^s_k,   h = (l + v) / |l + v|.

    after Han, Wang, Xu, supplement. Raises `ReflectanceError` when shapes disagree, or a known vertex has a
    negative number or none.
    """

    diffuse_linear: FloatArray
    """(V, 3): albedo c, not negative; NaN where it is not known."""
    weights: FloatArray
    """(V, 3): of the lobes with `EXPONENTS`, not negative, achromatic; NaN where they are not known."""
    known: BoolArray
    """(V,): vertices with numbers."""

    def __post_init__(self) -> None:
        diffuse = checked_array(self.diffuse_linear, ("V", 3), "diffuse_linear", ReflectanceError)
        weights = checked_array(self.weights, diffuse.shape, "weights", ReflectanceError)
        known = checked_array(self.known, diffuse.shape[:1], "known", ReflectanceError, kind=bool)
        numbers = np.concatenate([diffuse, weights], axis=1)
        good = (np.isfinite(numbers) & (numbers >= 0)).all(axis=1)
        if (known & ~good).any():
            first = np.flatnonzero(known & ~good)[0]
            raise ReflectanceError(f"vertex {first} is known, but not finite or negative: {numbers[first]}")
        diffuse, weights = (np.where(known[:, None], values, np.nan) for values in (diffuse, weights))
        vars(self).update(diffuse_linear=diffuse, weights=weights, known=known)

    def chosen(self, rows: IntArray) -> VertexReflectance:
        """Return the reflectance of some vertices."""
        return VertexReflectance(self.diffuse_linear[rows], self.weights[rows], self.known[rows])


def among_all(rows: IntArray, count: int, values: FloatArray, otherwise: float = np.nan) -> FloatArray:
    """Return values (R, ...) of the vertices `rows` (R,) among all `count`; the others have `otherwise`."""
    every = np.full((count, *values.shape[1:]), otherwise)
    every[rows] = values
    return every


def require_one_topology(one: str, count: int, other: str, expected: int) -> None:
    """Raise ReflectanceError, naming both in words, for numbers of vertices that differ."""
    if count != expected:
        raise ReflectanceError(f"{one} has {count} vertices, {other} {expected}; bring all to one topology")


def checked_coefficients(values: ArrayLike | None, shape: tuple[int, ...], name: str) -> FloatArray:
    """Return coefficients, 0 for None; `ValueError` for another shape, `ReflectanceError` for NaN."""
    coefficients = np.zeros(shape) if values is None else np.array(values, float)
    return checked_array(coefficients, shape, name, finite=ReflectanceError)


def check_exponents(exponents: tuple[float, ...], place: str) -> None:
    """Raise ReflectanceError when reflectance at `place`, in words, has other lobes than `EXPONENTS`."""
    if exponents != EXPONENTS:
        raise ReflectanceError(f"{place} has lobes of exponents {exponents}, expected {EXPONENTS}")


def lobe_weights_of_phong(strength: float, exponent: float) -> FloatArray:
    """Return (3,) weights of the lobes with `EXPONENTS` that together are nearest to a Phong highlight.

        sum_k w_k (s_k + 2) / 8 cos(a)^s_k  ~  strength cos(2 a)^exponent,

    least squares with w >= 0 over half vectors at angles a = 0 ... pi / 4 from the normal, by solid angle.
    The factor pi of the light (an albedo estimate's is the radiance of a white surface) has been divided out.
    `strength`, 0 or more, and `exponent`, more than 0, are those of an albedo estimate's highlight; others
    raise `ReflectanceError`.
    """
    from scipy.optimize import nnls

    if not (np.isfinite(strength) and strength >= 0 and np.isfinite(exponent) and exponent > 0):
        raise ReflectanceError(
            f"a highlight of strength {strength} and exponent {exponent}: expected finite "
            "numbers, strength 0 or more and exponent above 0"
        )
    angle = (np.arange(400) + 0.5) * np.pi / 4 / 400
    root = np.sqrt(np.sin(angle))
    lobes = np.stack([(s + 2) / 8 * np.cos(angle) ** s for s in EXPONENTS], 1)
    weights, _ = nnls(lobes * root[:, None], np.cos(2 * angle) ** exponent * root)
    return strength * weights


def reflectance_from_albedo(
    albedo_linear: ArrayLike, *, weights: ArrayLike = (0.0, 0.0, 0.0), known: ArrayLike | None = None
) -> VertexReflectance:
    """Return the reflectance of vertices with an albedo and weights of the lobes.

    Raises `ReflectanceError` when shapes disagree, or a known vertex has a negative number or none.

    Parameters
    ----------
    albedo_linear : (V, 3) array_like of float
        NaN where it is not known.
    weights : (3,) or (V, 3) array_like of float
        Of the lobes with `EXPONENTS`, one set for all or one a vertex; see `lobe_weights_of_phong`.
    known : (V,) array_like of bool, optional
        Vertices to keep, those with a finite albedo when omitted.
    """
    albedo = checked_array(albedo_linear, ("V", 3), "albedo_linear", ReflectanceError)
    lobes = np.asarray(weights, float)
    if lobes.shape not in ((3,), albedo.shape):
        raise ReflectanceError(f"weights are {lobes.shape}, expected (3,) or {albedo.shape}")
    kept = finite_rows(albedo) if known is None else np.asarray(known)
    return VertexReflectance(albedo, np.broadcast_to(lobes, albedo.shape), cast("BoolArray", kept))
