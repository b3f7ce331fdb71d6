"""A caller's own measure of how alike two sets of vertex colours are, as a term of `fit_image`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import ReflectanceError

FloatArray = NDArray[np.float64]
PerceptualDistance = Callable[[FloatArray, FloatArray], tuple[float, ArrayLike]]
"""From predicted and observed linear colours (V, 3), NaN at vertices that are not used, to a value and its
gradient (V, 3) by the predicted ones; gradients at vertices that are not used are not looked at."""


@dataclass(frozen=True)
class PerceptualValue:
    """The distance at one prediction."""

    value: float
    gradient: FloatArray
    """(U, 3) by the colours used."""

    @property
    def first_curvature(self) -> float:
        """Second derivative of a multiple of the squared distance to what has the value 0."""
        return float(np.sum(self.gradient**2)) / (2 * abs(self.value)) if self.value else 0.0


class PerceptualTerm:
    """Calls the caller's function and checks what it returns.

    Parameters
    ----------
    distance : callable
        See `PerceptualDistance`.
    used : (U,) int64
        Vertices whose colours are predicted.
    observed_linear : (U, 3) float64
    count : int
        V.
    """

    def __init__(
        self, distance: PerceptualDistance, used: NDArray[np.int64], observed_linear: FloatArray, count: int
    ) -> None:
        self._distance, self._used, self._count = distance, used, count
        self._observed = self._spread(observed_linear)

    def at(self, color: FloatArray) -> PerceptualValue:
        """Return value and gradient at predicted colours (U, 3)."""
        # Copies, so that a function that writes into its arguments harms nobody.
        answer = self._distance(self._spread(color), self._observed.copy())
        try:
            value, gradient = float(answer[0]), np.asarray(answer[1], np.float64)
        except (TypeError, ValueError, IndexError) as error:
            raise ReflectanceError(
                f"the perceptual function returned {type(answer).__name__}, expected a number and its "
                f"gradient ({self._count}, 3) by the predicted colours"
            ) from error
        if gradient.shape != (self._count, 3):
            raise ReflectanceError(
                f"the perceptual function returned a gradient {gradient.shape}, expected ({self._count}, 3), "
                "one row for each vertex"
            )
        bad = ~np.isfinite(gradient[self._used]).all(1)
        if not np.isfinite(value) or bad.any():
            what = f"the value {value}" if not np.isfinite(value) else f"no gradient at {bad.sum()} vertices"
            raise ReflectanceError(
                f"the perceptual function returned {what}; it must leave out vertices that are NaN in the "
                "predicted colours"
            )
        return PerceptualValue(value, gradient[self._used])

    def _spread(self, color: FloatArray) -> FloatArray:
        result = np.full((self._count, 3), np.nan)
        result[self._used] = color
        return result


def secant_curvature(before: PerceptualValue, after: PerceptualValue, step: FloatArray) -> float:
    """Return the second derivative along a step (U, 3) of the colours, 0 where it is negative."""
    length = float(np.sum(step**2))
    bend = float(np.sum((after.gradient - before.gradient) * step))
    return max(bend / length, 0.0) if length > 0 else 0.0
