"""The robust residual over blocks, its gradient and its Gauss-Newton matrix in one compiled pass."""

from __future__ import annotations

import numpy as np
from numba import njit

_SWEEPS = 3
"""Reweighted estimates of the block albedos an evaluation; the weights start from the last evaluation's."""


@njit(cache=True, nogil=True)
def block_albedos(value, weight, light, specular, blocks, softness, robust, albedo, mass):  # type: ignore[no-untyped-def]
    """Fill `albedo` (B,): the robust sum w (T - I_s) I / sum w I^2 of each block, and `mass` (B,) sum w I^2.

    `robust` (S, N) holds the weights of iterative reweighting and is updated.
    """
    for _ in range(_SWEEPS):
        albedo[:] = 0.0
        mass[:] = 0.0
        for s in range(blocks.shape[0]):
            for i in range(value.size):
                block = blocks[s, i]
                w = weight[i] * robust[s, i]
                albedo[block] += w * (value[i] - specular[i]) * light[i]
                mass[block] += w * light[i] * light[i]
        for block in range(albedo.size):
            albedo[block] = max(albedo[block], 0.0) / mass[block] if mass[block] > 0.0 else 0.0
        for s in range(blocks.shape[0]):
            for i in range(value.size):
                r = weight[i] * (value[i] - specular[i] - albedo[blocks[s, i]] * light[i])
                robust[s, i] = weight[i] / np.sqrt(r * r + softness * softness)
    mass[:] = 0.0
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            mass[blocks[s, i]] += weight[i] * robust[s, i] * light[i] * light[i]


@njit(cache=True, nogil=True)
def normal_equations(  # type: ignore[no-untyped-def]
    value,
    weight,
    light,
    specular,
    light_slope,
    specular_slope,
    blocks,
    softness,
    robust,
    albedo,
    mass,
    matrix,
    gradient,
):
    """Return sum sqrt((w r)^2 + e^2) - e with r = T - I_s - a_b I, and fill its normal equations.

    The block albedos a_b are eliminated: their part of the Gauss-Newton matrix is taken out by the Schur
    complement, so that a step in the P parameters of the light lets them follow.

    Parameters
    ----------
    value, weight : (N,) float64
        T; w, of which `weight` times `value` is about 1.
    light, specular : (N,) float64
    light_slope, specular_slope : (>= P, N) float64
        See `lighting.kernels.shade_with_derivatives`.
    blocks : (S, N) int32
    softness : float
        e: residuals beyond it count by their size, not their square.
    robust : (S, N) float64
        Updated, see `block_albedos`.
    albedo, mass : (B,) float64
        Filled.
    matrix, gradient : (P, P), (P,) float64
        Filled; the step that solves ``matrix step = gradient`` lessens the cost.

    References
    ----------
    .. [1] G. Golub, V. Pereyra, "Separable nonlinear least squares: the variable projection method and its
       applications", Inverse Problems 19(2), 2003.
    """
    block_albedos(value, weight, light, specular, blocks, softness, robust, albedo, mass)
    size = gradient.size
    matrix[:, :] = 0.0
    gradient[:] = 0.0
    cross, slope = np.zeros((albedo.size, size)), np.zeros(size)
    cost = 0.0
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            block = blocks[s, i]
            rest = value[i] - specular[i] - albedo[block] * light[i]
            r = weight[i] * rest
            cost += np.sqrt(r * r + softness * softness) - softness
            w = weight[i] * robust[s, i]
            for j in range(size):
                slope[j] = specular_slope[j, i] + albedo[block] * light_slope[j, i]
            for j in range(size):
                weighted = w * slope[j]
                gradient[j] += weighted * rest
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
    return cost


@njit(cache=True, nogil=True)
def cluster_scores(  # type: ignore[no-untyped-def]
    value,
    weight,
    light,
    specular,
    light_slope,
    specular_slope,
    blocks,
    softness,
    robust,
    albedo,
    mass,
    clusters,
    scores,
    costs,
):
    """Fill `scores` (C, P) and `costs` (C,): each cluster's part of the gradient and of the cost.

    The other arguments are as `normal_equations` left them. `clusters` (N,) are patches of the surface:
    texture correlates within them, hardly between them.
    """
    size = scores.shape[1]
    scores[:, :] = 0.0
    costs[:] = 0.0
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
            r = weight[i] * rest
            costs[clusters[i]] += np.sqrt(r * r + softness * softness) - softness
            w = weight[i] * robust[s, i] * rest
            for j in range(size):
                slope = specular_slope[j, i] + albedo[block] * light_slope[j, i]
                if mass[block] > 0.0:
                    slope -= cross[block, j] / mass[block] * light[i]
                scores[clusters[i], j] += w * slope
