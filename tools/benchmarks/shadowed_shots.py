"""Pictures of painted faces under environment maps with ray-traced shadows, for benchmarks.

Light is summed over the middles of 8,192 quarter texels, and shadows are cast by a surface four times finer
than the one that is fitted: neither knows harmonics or the sums of `light_transfer`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from benchmarks.everyday_light import SHAPE
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import map_directions
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.reflectance import EXPONENTS, VertexReflectance

ROWS, COLUMNS = 2 * SHAPE[0], 2 * SHAPE[1]
_BLOCK = 128


@cache
def _texels() -> tuple[np.ndarray, np.ndarray]:
    """Directions (D, 3) and solid angles (D,) of quarter texels."""
    polar = (np.arange(ROWS)[:, None] + 0.5) * np.pi / ROWS
    toward = map_directions(polar, ((np.arange(COLUMNS) + 0.5) / COLUMNS - 0.5) * 2 * np.pi)
    edges = np.cos(np.arange(ROWS + 1) * np.pi / ROWS)
    return toward.reshape(-1, 3), np.repeat((edges[:-1] - edges[1:]) * 2 * np.pi / COLUMNS, COLUMNS)


class ShadowedSurface:
    """V vertices, and the occluder (vertices, faces) that may be finer than their own mesh."""

    def __init__(self, vertices, normals, view, occluder) -> None:  # type: ignore[no-untyped-def]
        self.normals, self.view = normals, view
        shadows = ShadowMap(RayCaster(*occluder), vertices, normals)
        self.visible = shadows.table(_texels()[0]).visibility

    def received(self, environments: Sequence[np.ndarray], *, shadows: bool = True) -> np.ndarray:
        """Return (K, V, 4, 3): what a white diffuse surface and each lobe of weight 1 send under K maps."""
        toward, solid_angle = _texels()
        fine = [np.repeat(np.repeat(e, 2, 0), 2, 1).reshape(-1, 3) for e in environments]
        light = np.concatenate(fine, axis=1) * solid_angle[:, None]
        result = np.empty((len(self.normals), 4, light.shape[1]))
        for start in range(0, len(result), _BLOCK):
            block = slice(start, start + _BLOCK)
            n, v = self.normals[block], self.view[block]
            lit = self.visible[:, block].T if shadows else 1.0
            n_l, n_v = n @ toward.T, np.einsum("vi,vi->v", n, v)[:, None]
            half = np.sqrt(np.maximum(2 + 2 * (v @ toward.T), 1e-12))
            n_h = np.maximum(np.where(n_l > 0, (n_l + n_v) / half, 0.0), 0.0)
            result[block, 0] = (lit * np.maximum(n_l, 0) / np.pi) @ light
            for k, s in enumerate(EXPONENTS):
                result[block, 1 + k] = (lit * (n_l > 0) * (s + 2) / (8 * np.pi) * n_h**s) @ light
        return np.moveaxis(result.reshape(len(result), 4, len(environments), 3), 2, 0)


def sent(face: VertexReflectance, received: np.ndarray) -> np.ndarray:
    """Return (V, 3) radiance of a face that receives (V, 4, 3)."""
    specular = np.einsum("vk,vkj->vj", face.weights, received[:, 1:])
    return np.asarray(face.diffuse_linear * received[:, 0] + specular)
