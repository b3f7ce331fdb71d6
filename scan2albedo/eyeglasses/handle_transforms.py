"""Transforms that carry each key point, and its surroundings, to a target."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.keypoints import SKELETON
from scan2albedo.eyeglasses.motion_kernels import settle_rotations
from scan2albedo.geometry.mesh import normalized

FloatArray = NDArray[np.float64]

PRIOR = 0.1
"""Pull of a key point's neighbours on its rotation, beside 1 for each of its bones: what turns around a
straight bone shows in no key point."""
_SWEEPS, _SETTLED = 100, 1e-13


def translations(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (K, 4, 4) translations from `source` (K, 3) to `target` (K, 3): v' = v + W (target - source)."""
    result = np.tile(np.eye(4), (len(source), 1, 1))
    result[:, :3, 3] = target - source
    return result


def turned_translations(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (K, 4, 4) rigid transforms x -> R_k (x - source_k) + target_k that follow the skeleton.

    R_k is the rotation nearest to

        sum over bones (k, j) of b_kj a_kj^T + 0.1 mean_j R_j,

    a and b the bones' unit directions before and after, by sweeps from R = 1 until they settle. A
    rigid motion of all key points, or of one side, is met exactly by the first term and kept by the second.

    Parameters
    ----------
    source, target : (K, 3) float64
        In the order of `KEY_POINT_NAMES`; bones with NaN ends do not count.
    """
    bones = known_bones(source + target)
    k, j = bones.T
    before, after = (normalized(points[j] - points[k]) for points in (source, target))
    turns = np.zeros((len(source), 3, 3))
    np.add.at(turns, k, after[:, :, None] * before[:, None, :])
    degree = np.bincount(k, minlength=len(source))
    turns[degree == 0] = np.eye(3)
    share = np.zeros((len(source), len(source)))
    share[k, j] = PRIOR / degree[k]
    start = np.tile(np.eye(3), (len(source), 1, 1))
    rotations = settle_rotations(turns, share, start, _SWEEPS, _SETTLED)
    result = np.tile(np.eye(4), (len(source), 1, 1))
    result[:, :3, :3] = rotations
    result[:, :3, 3] = target - np.einsum("kij,kj->ki", rotations, source)
    return result


def known_bones(points: FloatArray) -> NDArray[np.int64]:
    """Return (B, 2) bones in both directions whose ends are finite."""
    bones = np.array(SKELETON)
    both = np.concatenate([bones, bones[:, ::-1]])
    return both[np.isfinite(points.sum(1))[both].all(1)]
