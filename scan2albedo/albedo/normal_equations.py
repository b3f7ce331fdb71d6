"""The robust residual over blocks, its gradient and its Gauss-Newton matrix, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def block_albedos(value, weight, light, specular, blocks, softness, robust, albedo, mass, sweeps):  # type: ignore[no-untyped-def]
    """Fill `albedo` (B,), the robust sum w (T - I_s) I / sum w I^2 of each block; return the cost with it.

    The cost is sum sqrt((w r)^2 + e^2) - e with r = T - I_s - a_b I; `mass` (B,) gets sum w I^2. `robust`
    (S, N), the weights of iterative reweighting, is updated in each of the `sweeps`.
    """
    sums, cost = np.zeros(albedo.size), 0.0
    for sweep in range(sweeps + 1):
        if sweep > 0:
            for block in range(albedo.size):
                albedo[block] = max(sums[block], 0.0) / mass[block] if mass[block] > 0.0 else 0.0
        sums[:] = 0.0
        mass[:] = 0.0
        cost = 0.0
        for s in range(blocks.shape[0]):
            for i in range(value.size):
                block, rest = blocks[s, i], value[i] - specular[i]
                if sweep > 0:
                    r = weight[i] * (rest - albedo[block] * light[i])
                    spread = np.sqrt(r * r + softness * softness)
                    cost += spread - softness
                    robust[s, i] = weight[i] / spread
                w = weight[i] * robust[s, i]
                sums[block] += w * rest * light[i]
                mass[block] += w * light[i] * light[i]
    return cost


@njit(cache=True, nogil=True)
def normal_equations(  # type: ignore[no-untyped-def]
    value,
    weight,
    light,
    specular,
    light_slope,
    specular_slope,
    blocks,
    robust,
    albedo,
    mass,
    matrix,
    gradient,
):
    """Fill the normal equations of the cost that `block_albedos` returned, around what it left.

    The block albedos a_b are eliminated: their part of the Gauss-Newton matrix is taken out by the Schur
    complement, so that a step in the P parameters of the light lets them follow [1]_.

    `value`, `light`, `specular` (N,) are T, I and I_s; w, `weight` (N,), times `value` is about 1.
    `light_slope`, `specular_slope` (>= P, N) come from `lighting.kernels.shade_with_derivatives`, `robust`,
    `albedo`, `mass` from `block_albedos`; `blocks` (S, N) are int32. `matrix` (P, P) and `gradient` (P,) are
    filled; the step that solves ``matrix step = -gradient`` lessens the cost.

    .. [1] G. Golub, V. Pereyra, "Separable nonlinear least squares: the variable projection method and its
       applications", Inverse Problems 19(2), 2003.
    """
    size = gradient.size
    matrix[:, :] = 0.0
    gradient[:] = 0.0
    cross, slope = np.zeros((albedo.size, size)), np.zeros(size)
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            block = blocks[s, i]
            rest = value[i] - specular[i] - albedo[block] * light[i]
            w = weight[i] * robust[s, i]
            for j in range(size):
                slope[j] = specular_slope[j, i] + albedo[block] * light_slope[j, i]
            for j in range(size):
                weighted = w * slope[j]
                gradient[j] -= weighted * rest
                cross[block, j] += weighted * light[i]
                for k in range(j + 1):
                    matrix[j, k] += weighted * slope[k]
    for block in range(albedo.size):
        if mass[block] > 0.0:
            for j in range(size):
                for k in range(j + 1):
                    matrix[j, k] -= cross[block, j] * cross[block, k] / mass[block]
    for j in range(size):
        for k in range(j):
            matrix[k, j] = matrix[j, k]


@njit(cache=True, nogil=True)
def cluster_scores(  # type: ignore[no-untyped-def]
    value,
    weight,
    light,
    specular,
    light_slope,
    specular_slope,
    blocks,
    robust,
    albedo,
    mass,
    clusters,
    scores,
):
    """Fill `scores` (C, P) with each cluster's part of the gradient of `normal_equations`.

    `clusters` (N,) are patches of the surface: texture correlates within them, hardly between them.
    """
    size = scores.shape[1]
    scores[:, :] = 0.0
    cross = np.zeros((albedo.size, size))
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            block = blocks[s, i]
            w = weight[i] * robust[s, i] * light[i]
            for j in range(size):
                cross[block, j] += w * (specular_slope[j, i] + albedo[block] * light_slope[j, i])
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            block = blocks[s, i]
            rest = value[i] - specular[i] - albedo[block] * light[i]
            w = weight[i] * robust[s, i] * rest
            for j in range(size):
                slope = specular_slope[j, i] + albedo[block] * light_slope[j, i]
                if mass[block] > 0.0:
                    slope -= cross[block, j] / mass[block] * light[i]
                scores[clusters[i], j] -= w * slope
