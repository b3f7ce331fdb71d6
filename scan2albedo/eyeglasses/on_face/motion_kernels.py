"""Compiled loops over the points of a moving frame: places, and sums of squares of what is measured there."""

from __future__ import annotations

import numpy as np
from numba import njit

_NEGLIGIBLE = 1e-9
"""Weights below this, which most are, do not count in derivatives; they do in positions."""


@njit(cache=True, nogil=True)
def blend_positions(rest, weights, transforms):  # type: ignore[no-untyped-def]
    """Return (N, 3) points of rest (N, 3) under the weighted mean of transforms (K, 4, 4)."""
    count, handles = weights.shape
    result = np.empty((count, 3))
    mean = np.empty((3, 4))
    for n in range(count):
        mean[:] = 0.0
        for k in range(handles):
            w = weights[n, k]
            if w != 0.0:
                for i in range(3):
                    for j in range(4):
                        mean[i, j] += w * transforms[k, i, j]
        for i in range(3):
            result[n, i] = (
                mean[i, 0] * rest[n, 0] + mean[i, 1] * rest[n, 1] + mean[i, 2] * rest[n, 2] + mean[i, 3]
            )
    return result


@njit(cache=True, nogil=True)
def _row(rest, weights, position, slope, turns, keypoints, rotation, origin, row, place):  # type: ignore[no-untyped-def]
    """Write the derivatives of one value that are not 0, and their places; return how many there are.

    By the frame's turn and translation, by the key points' shifts at fixed turns of the handles, and by
    these turns.
    """
    handles = len(weights)
    gx, gy, gz = slope[0], slope[1], slope[2]
    x, y, z = position[0] - origin[0], position[1] - origin[1], position[2] - origin[2]
    row[0], row[1], row[2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    row[3], row[4], row[5] = gx, gy, gz
    for i in range(6):
        place[i] = i
    used = 6
    lx = rotation[0, 0] * gx + rotation[1, 0] * gy + rotation[2, 0] * gz
    ly = rotation[0, 1] * gx + rotation[1, 1] * gy + rotation[2, 1] * gz
    lz = rotation[0, 2] * gx + rotation[1, 2] * gy + rotation[2, 2] * gz
    for k in range(handles):
        w = weights[k]
        if abs(w) < _NEGLIGIBLE:
            continue
        ax, ay, az = rest[0] - keypoints[k, 0], rest[1] - keypoints[k, 1], rest[2] - keypoints[k, 2]
        bx = turns[k, 0, 0] * ax + turns[k, 0, 1] * ay + turns[k, 0, 2] * az
        by = turns[k, 1, 0] * ax + turns[k, 1, 1] * ay + turns[k, 1, 2] * az
        bz = turns[k, 2, 0] * ax + turns[k, 2, 1] * ay + turns[k, 2, 2] * az
        px, py, pz = w * lx, w * ly, w * lz
        row[used], row[used + 1], row[used + 2] = px, py, pz
        row[used + 3], row[used + 4], row[used + 5] = by * pz - bz * py, bz * px - bx * pz, bx * py - by * px
        for i in range(3):
            place[used + i] = 6 + 3 * k + i
            place[used + 3 + i] = 6 + 3 * handles + 3 * k + i
        used += 6
    return used


@njit(cache=True, nogil=True)
def point_covariances(rest, weights, positions, turns, keypoints, rotation, origin, root):  # type: ignore[no-untyped-def]
    """Return (N, 3, 3) covariances of points under parameters of covariance root root^T.

    `root` is (6 + 6 K, P), in the order of `normal_sums`, whose other arguments these are.
    """
    count, size, parameters = len(rest), 6 + 6 * weights.shape[1], root.shape[1]
    result = np.empty((count, 3, 3))
    row, place, axes = np.empty(size), np.empty(size, np.int64), np.eye(3)
    spread = np.empty((3, parameters))
    for n in range(count):
        spread[:] = 0.0
        for i in range(3):
            used = _row(
                rest[n], weights[n], positions[n], axes[i], turns, keypoints, rotation, origin, row, place
            )
            for a in range(used):
                for p in range(parameters):
                    spread[i, p] += row[a] * root[place[a], p]
        for i in range(3):
            for j in range(i + 1):
                total = 0.0
                for p in range(parameters):
                    total += spread[i, p] * spread[j, p]
                result[n, i, j] = total
                result[n, j, i] = total
    return result


@njit(cache=True, nogil=True)
def normal_sums(  # type: ignore[no-untyped-def]
    rest, weights, positions, slopes, values, votes, turns, keypoints, rotation, origin, with_matrix
):
    """Return gradient (S,) and matrix (S, S), S = 6 + 6 K, of sum of vote value^2 / 2 over N points.

    Derivatives are by the frame's turn and translation, by the key points' shifts at fixed turns of the
    handles, and by these turns. Most weights are 0, so rows are summed without their zeros. Points are `rest`
    (N, 3) at rest and `positions` (N, 3) in the world, where `slopes` (N, 3) are the values' derivatives;
    `turns` (K, 3, 3) rotate the handles, `rotation` (3, 3) and `origin` (3,) take the frame to the world.
    """
    count, handles = weights.shape
    size = 6 + 6 * handles
    gradient, matrix = np.zeros(size), np.zeros((size, size))
    row, place = np.empty(size), np.empty(size, np.int64)
    for n in range(count):
        vote = votes[n]
        slope = slopes[n]
        if vote == 0.0 or (slope[0] == 0.0 and slope[1] == 0.0 and slope[2] == 0.0):
            continue
        used = _row(rest[n], weights[n], positions[n], slope, turns, keypoints, rotation, origin, row, place)
        for a in range(used):
            pa = place[a]
            va = vote * row[a]
            gradient[pa] += va * values[n]
            if with_matrix:
                for b in range(a + 1):
                    matrix[pa, place[b]] += va * row[b]
    # Places within a row do not ascend, so either triangle may hold a pair.
    for a in range(size):
        for b in range(a):
            total = matrix[a, b] + matrix[b, a]
            matrix[a, b] = total
            matrix[b, a] = total
    return gradient, matrix
