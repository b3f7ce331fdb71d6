"""Transforms that carry each key point, and its surroundings, to a target."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.keypoints import SKELETON

FloatArray = NDArray[np.float64]

_PRIOR = 0.1
"""Pull of a key point's neighbours on its rotation, beside 1 for each of its bones: what turns around a
straight bone shows in no key point."""
_ROUNDS = 12


def translations(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (K, 4, 4) translations from `source` (K, 3) to `target` (K, 3): v' = v + W (target - source)."""
    result = np.tile(np.eye(4), (len(source), 1, 1))
    result[:, :3, 3] = target - source
    return result


def turned_translations(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (K, 4, 4) rigid transforms x -> R_k (x - source_k) + target_k that follow the skeleton.

    R_k is the rotation nearest to

        sum over bones (k, j) of b_kj a_kj^T + 0.1 mean_j R_j,

    a and b the bones' unit directions before and after, by a few sweeps from R = 1. A rigid motion of all
    key points, or of one side, is met exactly by the first term and kept by the second.

    Parameters
    ----------
    source, target : (K, 3) float64
        In the order of `KEY_POINT_NAMES`; bones with NaN ends do not count.
    """
    neighbours = _neighbours(source + target)
    rotations = np.tile(np.eye(3), (len(source), 1, 1))
    for _ in range(_ROUNDS):
        wanted = np.tile(np.eye(3), (len(source), 1, 1))
        for k, near in enumerate(neighbours):
            if near:
                before, after = (_directions(points[near] - points[k]) for points in (source, target))
                wanted[k] = after.T @ before + _PRIOR * rotations[near].mean(0)
        rotations = _nearest_rotations(wanted)
    result = np.tile(np.eye(4), (len(source), 1, 1))
    result[:, :3, :3] = rotations
    result[:, :3, 3] = target - np.einsum("kij,kj->ki", rotations, source)
    return result


def _neighbours(known: FloatArray) -> list[list[int]]:
    finite = np.isfinite(known.sum(1))
    near: list[list[int]] = [[] for _ in known]
    for a, b in SKELETON:
        if finite[a] and finite[b]:
            near[a].append(b)
            near[b].append(a)
    return near


def _directions(bones: FloatArray) -> FloatArray:
    return bones / np.maximum(np.linalg.norm(bones, axis=1, keepdims=True), 1e-300)


def _nearest_rotations(matrices: FloatArray) -> FloatArray:
    """Return (K, 3, 3) rotations R of largest trace(R^T M)."""
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt
