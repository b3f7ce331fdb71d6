"""Exemplar synthesis of texels that a highlight saturated."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.albedo.poisson import forward_differences, integrate_gradients

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_NEIGHBOURS = 24
_PROBES = 80
_RADIUS = 40 / 512


def resynthesize(albedo: FloatArray, target: BoolArray, source: BoolArray, *, seed: int = 0) -> FloatArray:
    """Fill `target` with texture copied texel by texel from `source` around it, its seam blended.

    Non-hierarchical resynthesis: texels with most known neighbours come first; each takes the value of the
    place, among where its neighbours came from and random places within the search radius (40 texels at
    512), whose surroundings resemble its own most, by a robust (Cauchy) distance over its nearest known
    neighbours. Level differences are then spread over the target by Poisson blending.

    Parameters
    ----------
    albedo : (H, W, 3) float64
    target, source : (H, W) bool
        Texels to fill; texels to copy from.
    seed : int

    Returns
    -------
    (H, W, 3) float64; unchanged outside `target`, and everywhere when there is no source.

    References
    ----------
    .. [1] P. Harrison, "A non-hierarchical procedure for re-synthesis of complex textures", WSCG 2001.
    """
    origin = source & ~target
    if not target.any() or not origin.any():
        return albedo
    radius = max(4, round(_RADIUS * max(target.shape)))
    offsets = _near_offsets(max(6, radius // 4))
    spread = max(float(albedo[origin].std(0).mean()), 1e-4)
    filled = _fill(
        np.ascontiguousarray(albedo, np.float64),
        _order(target, origin),
        origin,
        offsets,
        radius,
        spread,
        _NEIGHBOURS,
        _PROBES,
        np.random.default_rng(seed),
    )
    return _blend(filled, target, origin)


def _near_offsets(reach: int) -> NDArray[np.int64]:
    """Return (K, 2) offsets without (0, 0), nearest first."""
    axis = np.arange(-reach, reach + 1)
    rows, columns = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    order = np.argsort(rows**2 + columns**2, kind="stable")[1:]
    return np.stack([rows, columns], 1)[order]


def _order(target: BoolArray, known: BoolArray) -> NDArray[np.int64]:
    """Return (T, 2) the target's texels, those with most known neighbours first (peeled layer by layer)."""
    kernel = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    left, done = target.copy(), np.pad(known, 1)
    layers: list[NDArray[np.int64]] = []
    while left.any():
        views = [done[1 + i : 1 + i + left.shape[0], 1 + j : 1 + j + left.shape[1]] for i, j in kernel]
        count = np.sum(views, axis=0)
        best = left & (count >= min(3, int(count[left].max())))
        rows, columns = np.nonzero(best)
        order = np.argsort(-count[best], kind="stable")
        layers.append(np.stack([rows[order], columns[order]], 1))
        left &= ~best
        done[1:-1, 1:-1] |= best
    return np.concatenate(layers)


@njit(cache=True, nogil=True)
def _fill(albedo, order, origin, offsets, radius, spread, neighbours, probes, rng):  # type: ignore[no-untyped-def]
    """Return a copy of `albedo` with the texels of `order` filled one after another."""
    height, width = origin.shape
    result, known = albedo.copy(), origin.copy()
    row_of, column_of = np.full((height, width), -1), np.full((height, width), -1)
    near_row, near_column = np.empty(neighbours, np.int64), np.empty(neighbours, np.int64)
    for t in range(order.shape[0]):
        row, column = order[t, 0], order[t, 1]
        found = 0
        for k in range(offsets.shape[0]):
            i, j = row + offsets[k, 0], column + offsets[k, 1]
            if 0 <= i < height and 0 <= j < width and known[i, j]:
                near_row[found], near_column[found] = offsets[k, 0], offsets[k, 1]
                found += 1
                if found == neighbours:
                    break
        best, best_row, best_column, reach = np.inf, -1, -1, radius
        attempt = 0
        while attempt < found + probes or best_row < 0:
            if attempt < found:
                i, j = row + near_row[attempt], column + near_column[attempt]
                if row_of[i, j] >= 0:
                    i, j = row_of[i, j], column_of[i, j]
                i, j = i - near_row[attempt], j - near_column[attempt]
            else:
                if attempt >= found + probes:
                    reach = min(2 * reach, height + width)
                i, j = (
                    row + int(rng.integers(-reach, reach + 1)),
                    column + int(rng.integers(-reach, reach + 1)),
                )
            attempt += 1
            if not (0 <= i < height and 0 <= j < width and origin[i, j]):
                continue
            distance = 0.0
            for k in range(found):
                a, b = i + near_row[k], j + near_column[k]
                if not (0 <= a < height and 0 <= b < width and origin[a, b]):
                    distance += 3.0
                    continue
                square = 0.0
                for c in range(3):
                    difference = result[row + near_row[k], column + near_column[k], c] - result[a, b, c]
                    square += difference * difference
                distance += np.log(1.0 + square / (spread * spread))
                if distance >= best:
                    break
            if distance < best:
                best, best_row, best_column = distance, i, j
        for c in range(3):
            result[row, column, c] = albedo[best_row, best_column, c]
        row_of[row, column], column_of[row, column] = best_row, best_column
        known[row, column] = True
    return result


def _blend(filled: FloatArray, target: BoolArray, known: BoolArray) -> FloatArray:
    """Return `filled` with the target's level bent to its border's; gradients inside stay."""
    result = filled.copy()
    seams = target[:, :-1] != target[:, 1:], target[:-1] != target[1:]
    for channel in range(3):
        field = np.log(np.maximum(filled[..., channel], 1e-4))
        across, down = (
            np.where(seam, 0.0, difference)
            for seam, difference in zip(seams, forward_differences(field), strict=True)
        )
        bent = integrate_gradients(field, target, known, across, down)
        result[..., channel] = np.where(target, np.exp(bent), filled[..., channel])
    return result
