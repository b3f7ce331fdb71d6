"""`PlacedLandmarks`: points that someone placed on a scan, by their numbers among the 68."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, all_finite
from scan2albedo.errors import ScanError, errors_of

LARGEST_COORDINATE = 1e30
"""Beyond it squared areas overflow; only garbage is that large."""
AUTO = "auto"
"""In place of landmarks: those that a network finds."""
COUNT = 68
"""Of iBUG-68, numbered from 0."""
PLACED_SIGMA_MM = 1.5
"""Standard deviation of a point of which nothing else is said: how well people repeat their own clicks."""


def landmarks_option(landmarks: Any) -> Any:
    """Return landmarks as a caller gave them, "auto" in any spelling as `AUTO`; ValueError for empty text."""
    if not isinstance(landmarks, str):
        return landmarks
    if not landmarks.strip():
        raise ValueError("landmarks is empty, expected a file, a folder or 'auto'")
    return AUTO if landmarks.strip().lower() == AUTO else landmarks


@dataclass(frozen=True)
class PlacedLandmarks:
    """Landmarks on a scan, each with how sure it is; arrays are checked and copied.

    Raises ScanError for wrong shapes, no point at all, points that are infinite or known in part, and
    deviations that are not above 0.
    """

    points: FloatArray
    """(68, 3): mm in the scan's frame, iBUG-68 order; NaN where none was placed."""
    sigma_mm: FloatArray
    """(68,): standard deviation along each axis."""

    def __post_init__(self) -> None:
        points, sigma_mm = np.array(self.points, float), np.array(self.sigma_mm, float)
        if points.shape != (COUNT, 3) or sigma_mm.shape != (COUNT,):
            said = f"landmarks have shape {points.shape} and deviations {sigma_mm.shape}"
            raise ScanError(f"{said}, expected ({COUNT}, 3) and ({COUNT},); leave NaN where none was placed")
        unknown, absurd = np.isnan(points), np.abs(points) > LARGEST_COORDINATE
        partly = np.flatnonzero((unknown.any(1) & ~unknown.all(1)) | absurd.any(1))
        if len(partly):
            raise ScanError(f"landmark {partly[0]} is {points[partly[0]].tolist()}, not three finite numbers")
        if unknown.all():
            raise ScanError("no landmark among the 68 is given; give at least one, or leave them out")
        if not (sigma_mm > 0).all() or not all_finite(sigma_mm):
            raise ScanError("a landmark's standard deviation must be finite and above 0 mm")
        vars(self).update(points=points, sigma_mm=sigma_mm)

    @classmethod
    def of(cls, landmarks: Any, mm_per_unit: float = 1.0) -> PlacedLandmarks:
        """Return landmarks given as {number: (3,)} or a (68, 3) array with NaN, in a scan's unit.

        Raises ScanError for unknown numbers and what `PlacedLandmarks` refuses, TypeError for other objects.
        """
        if isinstance(landmarks, PlacedLandmarks):
            return landmarks
        if isinstance(landmarks, Mapping):
            points = np.full((COUNT, 3), np.nan)
            for number, point in landmarks.items():
                if not isinstance(number, Integral) or int(number) not in range(COUNT):
                    raise ScanError(f"unknown landmark {number!r}; iBUG-68 has numbers from 0 to {COUNT - 1}")
                if np.shape(point) != (3,) or not all(isinstance(value, Real) for value in point):
                    raise ScanError(f"landmark {number} is {point!r}, expected three coordinates")
                points[int(number)] = point
        elif isinstance(landmarks, np.ndarray | list | tuple):
            with errors_of("landmarks are not a (68, 3) array of numbers", ScanError, ValueError, TypeError):
                points = np.asarray(landmarks, float)
        else:
            said = f"landmarks are of type {type(landmarks).__name__}"
            raise TypeError(f"{said}, expected a file, {{number: (x, y, z)}} or a (68, 3) array")
        return cls(points * mm_per_unit, np.full(COUNT, PLACED_SIGMA_MM))

    @property
    def placed(self) -> BoolArray:
        """(68,): which were placed."""
        return ~np.isnan(self.points[:, 0])

    def scaled(self, factor: float) -> PlacedLandmarks:
        """Return the points of the scan made `factor` times as large."""
        return replace(self, points=self.points * factor)
