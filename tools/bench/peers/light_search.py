"""A peer of the albedo stage that searches: SciPy's annealing on V of a geometry image.

It is told how many lights there are, and does not use `scan2albedo.albedo`.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import dual_annealing

import scan2albedo as s2a
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shading import Reflectance, shade_points
from scan2albedo.lighting.shadow_map import ShadowMap

WHITE = 0.995
"""Texels from here on say nothing about light."""
BLOCK_AREA = 0.125
"""Of a block of the objective, as a part of the chart: blocks have to be larger than the texture's grain."""
EXCESS = 3.0
"""Price of a highlight that is brighter than its texel, relative to other residuals."""
OFFSET_MM = 0.2
"""Shadow rays start this far above the surface."""


@dataclass(frozen=True)
class PeerAnswer:
    """Unlit V (H, W), the lights found (ambient = 1), and evaluations of the objective."""

    albedo_value: FloatArray
    lights: tuple[s2a.PointLight, ...]
    evaluations: int


def annealed(image: s2a.GeometryImage, light_count: int, *, evaluations: int) -> PeerAnswer:
    """Minimise the block residual over distant lights, Oren-Nayar and Phong by generalised annealing.

    Per light two angles and the logarithm of its strength; sigma, k_s and the logarithm of Phong's exponent
    are common. The objective is sum |T - I_s - a_b I| / sum T over blocks b with the least-squares albedo
    a_b, in four partitions that are half a block apart.

    Parameters
    ----------
    image : GeometryImage
    light_count : int
    evaluations : int
        Bound on evaluations of the objective.

    References
    ----------
    .. [1] Y. Xiang, D. Y. Sun, W. Fan, X. G. Gong, "Generalized simulated annealing algorithm and its
       application to the Thomson model", Physics Letters A 233, 1997.
    """
    mask, value = image.mask, _value(image)
    position, normal = image.position[mask], image.normal[mask]
    shadows = ShadowMap(RayCaster(*image.occluder_mesh()), position, normal, OFFSET_MM)
    weight = (value < WHITE).astype(float)
    blocks = _blocks(mask)

    def shade(x: FloatArray) -> tuple[list[s2a.PointLight], FloatArray, FloatArray]:
        lights = [
            s2a.PointLight(float(a), float(e), math.inf, math.exp(s))
            for a, e, s in x[: 3 * light_count].reshape(-1, 3)
        ]
        sigma, strength, exponent = x[3 * light_count :]
        reflectance = Reflectance("oren-nayar", float(sigma), float(strength), math.exp(exponent))
        visible = np.stack([shadows.visible(light.direction) for light in lights])
        shading = shade_points(
            position,
            normal,
            lights,
            reflectance,
            visible=visible,
            specular_scale=None if image.specular_scale is None else image.specular_scale[mask],
        )
        return lights, shading.light, shading.specular

    def cost(x: FloatArray) -> float:
        _, light, specular = shade(x)
        return block_residual(value, weight, light, specular, blocks)

    angles = [(-1.9, 1.9), (-1.4, 1.4), (math.log(0.1), math.log(20))]
    bounds = angles * light_count + [(0.0, 0.8), (0.0, 0.3), (math.log(2), math.log(100))]
    found = dual_annealing(
        cost,
        bounds,
        maxiter=10**6,
        maxfun=evaluations,
        no_local_search=True,
        rng=np.random.default_rng(0),
    )
    lights, light, specular = shade(found.x)
    albedo = np.zeros(mask.shape)
    albedo[mask] = np.maximum(value - specular, 0) / light
    return PeerAnswer(albedo, tuple(lights), int(found.nfev))


def block_residual(
    value: FloatArray, weight: FloatArray, light: FloatArray, specular: FloatArray, blocks: IntArray
) -> float:
    """Return sum w |T - I_s - a_b I| / sum w T, the mean over partitions (S, N) into blocks b.

    a_b = sum w (T - I_s) I / sum w I^2. What a highlight exceeds its texel by costs `EXCESS` times more.
    """
    rest = value - specular
    count = int(blocks.max()) + 1
    total = 0.0
    for block in blocks:
        top = np.bincount(block, weight * rest * light, count)
        bottom = np.bincount(block, weight * light * light, count)
        albedo = np.maximum(top, 0) / np.where(bottom > 0, bottom, 1)
        total += float(np.sum(weight * np.abs(rest - light * albedo[block])))
    excess = float(np.sum(weight * EXCESS * np.maximum(-rest, 0)))
    return (total / len(blocks) + excess) / float(np.sum(weight * value))


def _blocks(mask: BoolArray) -> IntArray:
    """Return (4, N) block indices: squares of `BLOCK_AREA` of the chart, moved by half a block each way."""
    side = math.sqrt(BLOCK_AREA * mask.sum())
    row, column = np.nonzero(mask)
    moved = itertools.product((0.0, 0.5), repeat=2)
    wide = int(max(mask.shape) / side) + 2
    return np.stack([(row / side + r).astype(int) * wide + (column / side + c).astype(int) for r, c in moved])


def _value(image: s2a.GeometryImage) -> FloatArray:
    """Return (N,) V of the masked texels."""
    return image.texture_linear[image.mask].astype(float).max(1)


SLOW_PEERS: dict[str, Callable[[s2a.GeometryImage, int], PeerAnswer]] = {
    "annealing 1000": partial(annealed, evaluations=1000),
    "annealing 4000": partial(annealed, evaluations=4000),
}
