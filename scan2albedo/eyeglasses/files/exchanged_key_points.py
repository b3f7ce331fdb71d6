"""Key points whose names are exchanged: found by where they lie on a typical frame."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR, typical_key_points
from scan2albedo.geometry.rigid import procrustes, transform_points

_FEWEST = 6
"""Key points that must be known: fewer place no frame."""
_SIDES = 0.5
"""Residual with all sides exchanged, as a part of that without, below which they are."""
_OPPOSED = -0.5
"""Cosine to the typical direction from one key point to another below which they are exchanged."""
_NEAR = 0.6
"""Distance of two key points, as a part of the typical one, below which their direction says nothing."""
_MOST = 10
"""Exchanges that are looked for."""
_LIKE_GLASSES = 0.1
"""Residual, as a part of the size, up to which key points with exchanges undone are those of glasses."""
_SAME_SIDE = (
    ("rim_top", "rim_bottom"),
    ("rim_inner", "rim_outer"),
    ("rim_bridge", "rim_outer"),
    ("rim_bridge", "rim_inner"),
    ("rim_bridge", "rim_bottom"),
    ("hinge", "temple_middle"),
    ("hinge", "ear_bend"),
    ("hinge", "temple_tip"),
    ("temple_middle", "ear_bend"),
    ("temple_middle", "temple_tip"),
    ("ear_bend", "temple_tip"),
)


def _candidates() -> list[tuple[int, int]]:
    number = {name: k for k, name in enumerate(KEY_POINT_NAMES)}
    pairs = [(0, 1)] + [(k, MIRROR[k]) for k in range(2, 11)]
    return pairs + [
        (number[f"{side}_{a}"], number[f"{side}_{b}"]) for side in ("left", "right") for a, b in _SAME_SIDE
    ]


def exchanged_key_points(points: FloatArray) -> list[str]:
    """Return which names of key points (20, 3), NaN for missing ones, seem exchanged, as phrases; mostly
    none.

    The exchange that brings the key points nearest to a typical frame, laid on them by a similarity, is made
    first, then the next. It counts where the two key points lie in the opposite direction of the typical one.
    """
    known = np.asarray(np.isfinite(points).all(1))
    if known.sum() < _FEWEST:
        return []
    typical, mirror = typical_key_points(), list(MIRROR)
    current, found = points.copy(), []
    if _misfit(current[mirror], typical) < _SIDES**2 * _misfit(current, typical):
        current = current[mirror]
        found.append("all left ones and all right ones (left is the wearer's)")
    for _ in range(_MOST):
        best, least = None, _misfit(current, typical)
        for a, b in _candidates():
            if known[[a, b]].all():
                trial = current.copy()
                trial[[a, b]] = current[[b, a]]
                misfit = _misfit(trial, typical)
                if misfit < least and _opposed(current, trial, typical, a, b):
                    best, least, changed = (a, b), misfit, trial
        if best is None:
            break
        current = changed
        found.append(" and ".join(KEY_POINT_NAMES[k] for k in best))
    size = np.linalg.norm(np.ptp(points[known], axis=0))
    rms = np.sqrt(_misfit(current, typical) / known.sum())
    return found if rms < _LIKE_GLASSES * size else []


def _laid(points: FloatArray, typical: FloatArray) -> FloatArray:
    """Return the typical key points (20, 3) laid on the known ones."""
    known = np.isfinite(points).all(1)
    return transform_points(procrustes(typical[known], points[known], scale=True), typical)


def _misfit(points: FloatArray, typical: FloatArray) -> float:
    return float(np.nansum((_laid(points, typical) - points) ** 2))


def _opposed(points: FloatArray, trial: FloatArray, typical: FloatArray, a: int, b: int) -> bool:
    laid = _laid(trial, typical)
    way, usual = points[b] - points[a], laid[b] - laid[a]
    lengths = np.linalg.norm(way), np.linalg.norm(usual)
    return bool(lengths[0] > _NEAR * lengths[1] and way @ usual < _OPPOSED * lengths[0] * lengths[1])
