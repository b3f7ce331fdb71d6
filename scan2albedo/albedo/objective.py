"""What a hypothesis about the light leaves unexplained: two objectives over blocks, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

from scan2albedo.lighting.kernels import shade

RESIDUAL, ALBEDO_DEVIATION = 0, 1
KINDS = {"residual": RESIDUAL, "albedo-deviation": ALBEDO_DEVIATION}

_EXCESS = 3.0


@njit(cache=True, nogil=True)
def block_residual(value, weight, light, specular, blocks, block_count):  # type: ignore[no-untyped-def]
    """Return sum w |T - I_s - I a_b| / sum w T, with a_b = sum w (T - I_s) I / sum w I^2 of each block.

    T is `value` (N,), I = I_a + I_d is `light`, I_s is `specular`; `blocks` (S, N) are S partitions, the
    result is their mean. Measured in the image, not in the albedo, so dark texels weigh little. A highlight
    brighter than the whole texel, which no albedo explains, costs its excess `_EXCESS` times more.
    """
    top, bottom = np.zeros(block_count), np.zeros(block_count)
    cost, total = 0.0, 0.0
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            b = blocks[s, i]
            top[b] += weight[i] * (value[i] - specular[i]) * light[i]
            bottom[b] += weight[i] * light[i] * light[i]
            total += weight[i] * value[i]
    for b in range(block_count):
        top[b] = max(top[b], 0.0) / bottom[b] if bottom[b] > 0.0 else 0.0
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            rest = value[i] - specular[i]
            cost += weight[i] * (abs(rest - light[i] * top[blocks[s, i]]) + _EXCESS * max(-rest, 0.0))
    return cost / total


@njit(cache=True, nogil=True)
def albedo_deviation(value, weight, light, specular, blocks, block_count):  # type: ignore[no-untyped-def]
    """Return sum w |A - mean_b A| / sum w A with A = (T - I_s) / I: the paper's objective, normalised.

    Without the division by sum w A it is degenerate: it falls as the lights grow stronger.

    References
    ----------
    .. [1] G. Toderici et al., "An automated method for human face modeling and relighting with
       application to face recognition", section 3.2.2.
    """
    mean, mass = np.zeros(block_count), np.zeros(block_count)
    cost, total = 0.0, 0.0
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            b = blocks[s, i]
            albedo = max(value[i] - specular[i], 0.0) / light[i]
            mean[b] += weight[i] * albedo
            mass[b] += weight[i]
            total += weight[i] * albedo
    if total <= 0.0:
        return np.inf
    for b in range(block_count):
        if mass[b] > 0.0:
            mean[b] /= mass[b]
    for s in range(blocks.shape[0]):
        for i in range(value.size):
            albedo = max(value[i] - specular[i], 0.0) / light[i]
            cost += weight[i] * abs(albedo - mean[blocks[s, i]])
    return cost / total


@njit(cache=True, nogil=True)
def evaluate(  # type: ignore[no-untyped-def]
    kind,
    position,
    normal,
    visible,
    value,
    weight,
    scale,
    blocks,
    block_count,
    lights,
    view,
    brdf,
    roughness,
    specular,
    exponent,
    light_out,
    specular_out,
):
    """Shade (see `lighting.kernels.shade`) and return the objective `kind`; the buffers keep I and I_s."""
    shade(
        position,
        normal,
        visible,
        lights,
        view,
        brdf,
        roughness,
        specular,
        exponent,
        scale,
        light_out,
        specular_out,
    )
    if kind == RESIDUAL:
        return block_residual(value, weight, light_out, specular_out, blocks, block_count)
    return albedo_deviation(value, weight, light_out, specular_out, blocks, block_count)
