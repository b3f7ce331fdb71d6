"""The mean of many frames' key points by generalised Procrustes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR, SKELETON
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rigid import procrustes, transform_points

_TYPICAL_BONE_MM = 30.0
"""Median length of the skeleton's bones of spectacles."""
_FLAT = 1e-3
"""Spread across a line, as a part of that along it, below which points fix no pose."""
_TOLERANCE = 1e-13
"""Change of the mean, as a part of its size, at which it has settled: rounding."""
_ROUNDS = 200
"""Most rounds of the mean."""
_TOPS, _BOTTOMS = (
    np.array([k for k, name in enumerate(KEY_POINT_NAMES) if name.endswith(end)])
    for end in ("_top", "_bottom")
)
"""Numbers of the highest and the lowest key points of bridge and rims, in one order."""


@dataclass(frozen=True)
class MeanKeyPoints:
    """What `mean_key_points` found."""

    points: FloatArray
    """(20, 3); NaN where no frame has the key point."""
    converged: bool
    iterations: int


def require_posable(points: FloatArray, owner: str = "") -> None:
    """Raise EyeglassesError, naming their owner, unless key points (20, 3) fix a pose and a size."""
    of = f"{owner}: " if owner else ""
    seen = points[np.isfinite(points).all(1)]
    if not is_posable(seen):
        cause = f"{len(seen)} key points are known"
        if len(seen) >= 3:
            cause = f"all {len(seen)} known key points lie on one line, or in one place"
        raise EyeglassesError(f"{of}{cause}; a pose takes three that span a plane: label more of them")
    if not key_point_size(points) > 0:
        raise EyeglassesError(f"{of}no two neighbouring key points are known and apart; label more of them")


def is_posable(seen: FloatArray) -> bool:
    """Return whether finite points (K, 3) span a plane."""
    spread = np.linalg.svd(seen - seen.mean(0), compute_uv=False) if len(seen) >= 3 else np.zeros(3)
    return bool(spread[1] > _FLAT * spread[0])


def usual_size_factor(points: FloatArray) -> float:
    """Return the factor that brings a frame's median bone to that of spectacles in mm."""
    return _TYPICAL_BONE_MM / key_point_size(points)


def mean_key_points(keypoints: Sequence[FloatArray], meter: Meter) -> MeanKeyPoints:
    """Return the mean of frames' key points (20, 3), in one unit, NaN for missing ones.

    Alternates x_k = mean over frames of (R_i p_ik + t_i) and the rigid Procrustes transforms (R_i, t_i) of
    each frame to x [1]_; sizes are kept. The mean lies in the glasses' own axes: x to the wearer's left, z to
    the front, the centroid at 0. The meter records its change in lengths of the skeleton's median bone.

    .. [1] J. C. Gower, "Generalized Procrustes analysis", Psychometrika 40(1), 1975.
    """
    mean = fullest(keypoints)
    size = key_point_size(mean)
    iteration, settled = 0, False
    while not settled and iteration < _ROUNDS and not (iteration and meter.exhausted):
        iteration += 1
        aligned = np.array([transform_points(align_key_points(p, mean), p) for p in keypoints])
        seen = np.isfinite(aligned).all(2)
        count = seen.sum(0)[:, None]
        total = np.where(seen[..., None], aligned, 0.0).sum(0)
        new = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        both = np.isfinite(mean).all(1)
        change = float(np.abs((new - transform_points(align_key_points(mean, new), mean))[both]).max())
        settled, mean = change <= _TOLERANCE * size and bool((both == (count[:, 0] > 0)).all()), new
        meter.count()
        meter.record(change / size)
    return MeanKeyPoints(in_own_axes(mean), settled, iteration)


def fullest(keypoints: Sequence[FloatArray]) -> FloatArray:
    """Return the first of the frames' key points (20, 3) that lack fewest: what the others are aligned to."""
    return max(keypoints, key=lambda points: int(np.isfinite(points).sum()))


def align_key_points(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the rigid `target_from_source` (4, 4) of the key points that both have, three or more."""
    both = np.isfinite(source).all(1) & np.isfinite(target).all(1)
    return procrustes(source[both], target[both])


def key_point_size(points: FloatArray) -> float:
    """Return the median length of the bones between known key points (20, 3); 0 where there is none."""
    bones = np.array(SKELETON)
    lengths = np.linalg.norm(points[bones[:, 0]] - points[bones[:, 1]], axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(np.median(lengths)) if len(lengths) else 0.0


def in_own_axes(points: FloatArray) -> FloatArray:
    """Return key points (20, 3) turned to the glasses' own axes, as far as those that are known fix them.

    Front is where temples come from; without temples it is across left and up, which the front tells.
    """
    across = points - points[list(MIRROR)]
    left = np.array([name.startswith("left") for name in KEY_POINT_NAMES])
    known = np.asarray(np.isfinite(points).all(1))
    pairs = left & np.isfinite(across).all(1)
    if not pairs.any():
        return points
    x = normalized(across[pairs].mean(0))
    forward = _forward(points, known, x)
    z = forward - (forward @ x) * x
    if not np.linalg.norm(z) > _FLAT * np.linalg.norm(forward):
        return points
    z = normalized(z)
    turned = (points - points[known].mean(0)) @ np.stack([x, np.cross(z, x), z]).T
    return np.asarray(turned)


def _forward(points: FloatArray, known: BoolArray, x: FloatArray) -> FloatArray:
    """Return about where key points (20, 3) look, `x` being their left; 0 where they do not tell."""
    back = np.array(["temple" in name or "ear" in name for name in KEY_POINT_NAMES])
    if (back & known).any() and (~back & known).any():
        return np.asarray(points[~back & known].mean(0) - points[back & known].mean(0))
    heights = points[_TOPS] - points[_BOTTOMS]
    return np.cross(x, heights[np.isfinite(heights).all(1)].sum(0))
