"""Soft light of several colours from all around, as in a room: windows, lit walls, a ceiling.

The sources are not spherical harmonics, as which the estimator represents soft light.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import adjacency, normalized
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.synthetic.renderer import SHADOW_OFFSET_MM, RayScene
from scan2albedo.synthetic.sitter import Sitter

_RAYS = 64
"""Directions from a vertex in which other parts of the sitter are looked for."""
_OPEN_RAYS = 512
"""Directions over which the light of the open room is summed."""
_BLOCK = 4096
"""Vertices at a time."""
_AVERAGED = 8
"""Times that what a vertex's rays found is averaged over its neighbours."""
_SHARPNESS = (1.5, 6.0)
"""Range: sources shine at half their strength 57 to 28 degrees from their middle."""
_SHARE = (0.3, 1.0)
"""Range of the light of each source, and of the walls, before all is scaled to a mean of 1."""


@dataclass(frozen=True)
class Room:
    """Radiance L(d) = walls + sum_k color_k exp(sharpness_k (d . direction_k - 1)) toward unit d.

    `walls` (3,), `directions` (K, 3) in the model's frame, `sharpness` (K,), `colors` (K, 3).
    """

    walls: FloatArray
    directions: FloatArray
    sharpness: FloatArray
    colors: FloatArray

    def radiance(self, toward: FloatArray) -> FloatArray:
        """Return (N, 3) along unit vectors (N, 3)."""
        lobes = np.exp(self.sharpness * (toward @ self.directions.T - 1))
        return np.asarray(self.walls + lobes @ self.colors)


def random_room(rng: np.random.Generator, color_deviation: float) -> Room:
    """Return a room whose radiance is 1 on average over directions and channels.

    `color_deviation` is that of the logarithms of red and blue over green of the walls and of each source.
    """
    count = int(rng.integers(2, 5))
    directions = normalized(rng.standard_normal((count, 3)))
    sharpness = rng.uniform(*_SHARPNESS, count)
    tints = random_colors(1 + count, rng, color_deviation) * rng.uniform(*_SHARE, (1 + count, 1))
    over_sphere = -np.expm1(-2 * sharpness) / (2 * sharpness)
    tints /= tints.sum(0).mean()
    return Room(tints[0], directions, sharpness, tints[1:] / over_sphere[:, None])


def random_colors(count: int, rng: np.random.Generator, deviation: float) -> FloatArray:
    """Return (count, 3) colours of green 1, red and blue with this deviation of their logarithms."""
    logarithms = np.zeros((count, 3))
    logarithms[:, [0, 2]] = rng.normal(0, deviation, (count, 2))
    return np.exp(logarithms)


def room_light_on(sitter: Sitter, scene: RayScene, rng: np.random.Generator, room: Room) -> FloatArray:
    """Return (V, 3) the light of a room on the sitter's vertices: shadowed by the sitter, with one bounce.

    A white surface that nothing hides from a room of radiance 1 has the light 1. Rays differ from vertex to
    vertex, and what they find, not what normals do, is averaged over about 2 mm of the face.
    """
    count = len(sitter.vertices)
    near = adjacency(count, sitter.faces) + sparse.identity(count)
    mean = sparse.diags(1 / np.asarray(near.sum(1)).ravel()) @ near

    def spread(values: FloatArray) -> FloatArray:
        for _ in range(_AVERAGED):
            values = mean @ values
        return values

    rays, hidden = [], []
    for first in range(0, count, _BLOCK):
        block = slice(first, first + _BLOCK)
        turn = rng.uniform(0, 2 * np.pi, (len(sitter.vertices[block]), 1))
        weight, face, toward = _rays(sitter.vertices[block], sitter.normals[block], turn, scene)
        rays.append((weight, face))
        arriving = weight[..., None] * room.radiance(toward)
        hidden.append((arriving * (face >= 0)[..., None]).sum(1) / np.maximum(arriving.sum(1), 1e-12))
    # Light on the open surface, of more directions, less what is hidden.
    toward = distant_directions(_OPEN_RAYS)
    radiance = room.radiance(toward) * (4 / _OPEN_RAYS)
    blocks = np.array_split(sitter.normals, count // _BLOCK + 1)
    open_light = np.concatenate([np.maximum(block @ toward.T, 0) @ radiance for block in blocks])
    direct = open_light * (1 - spread(np.concatenate(hidden)))
    centers = np.full((len(sitter.faces), 3), 1 / 3)
    thrown = sitter.albedo_at(np.arange(len(sitter.faces)), centers) * direct[sitter.faces].mean(1)
    # The last row is of rays that hit nothing.
    thrown = np.append(thrown, np.zeros((1, 3)), 0)
    bounced = [np.einsum("vd,vdc->vc", weight, thrown[face]) for weight, face in rays]
    return np.asarray(direct + spread(np.concatenate(bounced)))


def _rays(
    vertices: FloatArray, normals: FloatArray, turn: FloatArray, scene: RayScene
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return weights (N, D) of sum 1, the faces hit (N, D), -1 for none, and directions (N, D, 3).

    The directions are even ones, turned about +y by `turn` (N, 1) radians.
    """
    start = vertices + SHADOW_OFFSET_MM * normals
    c, s = np.cos(turn), np.sin(turn)
    x, y, z = distant_directions(_RAYS).T
    toward = np.stack([c * x + s * z, np.broadcast_to(y, c.shape[:1] + y.shape), c * z - s * x], -1)
    cosine = np.maximum(np.einsum("vc,vdc->vd", normals, toward), 0)
    face = np.full(cosine.shape, -1)
    vertex, ray = np.nonzero(cosine)
    face[vertex, ray] = scene.first_hit(start[vertex], toward[vertex, ray]).face
    return cosine / np.maximum(cosine.sum(1, keepdims=True), 1e-12), face, toward
