"""`VertexReflectance`: how each vertex of a face reflects light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ReflectanceError

FloatArray = NDArray[np.float64]

EXPONENTS = (1.0, 8.0, 64.0)
"""Of the three Blinn-Phong lobes."""


@dataclass(frozen=True)
class VertexReflectance:
    """Diffuse albedo and the weights of three Blinn-Phong lobes at V vertices.

    Under a light of unit radiant intensity at unit distance a vertex sends to the camera, where both see it,

        c / pi max(0, n.l) + sum_k w_k (s_k + 2) / (8 pi) max(0, n.h)^s_k,   h = (l + v) / |l + v|.

    Parameters
    ----------
    diffuse_linear : (V, 3) float64
        Albedo c, not negative; NaN where it is not known.
    weights : (V, 3) float64
        Of the lobes with `EXPONENTS`, not negative, achromatic; NaN where they are not known.
    known : (V,) bool
        Vertices with numbers.

    Raises
    ------
    ReflectanceError
        When shapes disagree, or a known vertex has a negative number or none.

    References
    ----------
    "Learning a 3D morphable face reflectance model from low-cost data", CVPR 2023, supplement.
    """

    diffuse_linear: FloatArray
    weights: FloatArray
    known: NDArray[np.bool_]

    def __post_init__(self) -> None:
        diffuse, weights = np.asarray(self.diffuse_linear, float), np.asarray(self.weights, float)
        known = np.asarray(self.known)
        if diffuse.ndim != 2 or diffuse.shape[1] != 3 or weights.shape != diffuse.shape:
            raise ReflectanceError(
                f"diffuse_linear is {diffuse.shape} and weights {weights.shape}, expected (V, 3) both"
            )
        if known.dtype != np.bool_ or known.shape != diffuse.shape[:1]:
            raise ReflectanceError(f"known is {known.dtype} {known.shape}, expected bool ({len(diffuse)},)")
        numbers = np.concatenate([diffuse, weights], axis=1)
        good = (np.isfinite(numbers) & (numbers >= 0)).all(axis=1)
        if (known & ~good).any():
            first = int(np.flatnonzero(known & ~good)[0])
            raise ReflectanceError(
                f"vertex {first} is said to be known, but its numbers are {numbers[first]}: expected finite "
                "and not negative"
            )
        object.__setattr__(self, "diffuse_linear", np.where(known[:, None], diffuse, np.nan))
        object.__setattr__(self, "weights", np.where(known[:, None], weights, np.nan))
        object.__setattr__(self, "known", known)


def refuse_other_lobes(exponents: tuple[float, ...], place: str) -> None:
    """Raise ReflectanceError when reflectance at `place`, in words, has other lobes than `EXPONENTS`."""
    if exponents != EXPONENTS:
        raise ReflectanceError(f"{place} has lobes of exponents {exponents}, expected {EXPONENTS}")
