"""Ways of light from distant lights to points: open, through lenses, or none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.light_kernels import (
    DARK,
    WAITING,
    ask_neighbours,
    lens_rays,
    mark_facing,
    set_paths,
    waiting_rays,
)
from scan2albedo.eyeglasses.lenses.shadow_stages import PointStage
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import shadow_origins

FloatArray = NDArray[np.float64]
Paths = NDArray[np.uint8]

_RAYS = 2**20
"""Rays that are shot at once: a bound on memory."""


def light_paths(
    caster: RayCaster,
    lenses: Sequence[InsertedLens],
    position: FloatArray,
    normal: FloatArray,
    toward: FloatArray,
    *,
    stages: Sequence[PointStage],
    offset_mm: float,
) -> Paths:
    """Return (N, K) how the light of K distant lights gets to N points.

    `DARK` where a surface is in the way, `AWAY` where the light is behind the point's own; otherwise
    1 + the sum of 2^j over the lenses j that it passes.

    Parameters
    ----------
    caster : RayCaster
        Of the surfaces.
    lenses : sequence of InsertedLens
    position, normal : (N, 3) float64
    toward : (K, 3) float64
        Unit directions to the lights.
    stages : sequence of PointStage
        All points, each once.
    offset_mm : float
        Rays start this far along the normal.
    """
    paths = np.empty((len(position), len(toward)), np.uint8)
    mark_facing(normal, toward, paths)
    start = shadow_origins(caster, position, normal, offset_mm)
    for stage in stages:
        ask_neighbours(stage.point, stage.near, paths)
        waiting = partial(waiting_rays, paths, stage.point, start, toward)
        _shoot(caster, paths, len(stage.point), waiting, hit=DARK - WAITING, free=1 - WAITING)
    for number, lens in enumerate(lenses):
        center, radius = _ball(lens.vertices)
        local = lens.caster.to_local(position)
        near = partial(lens_rays, paths, position, local, center, radius, toward)
        _shoot(lens.caster, paths, len(position), near, hit=2**number, free=0)
    return paths


def _shoot(
    caster: RayCaster,
    paths: Paths,
    count: int,
    gather: Callable[..., int],
    *,
    hit: int,
    free: int,
) -> None:
    """Shoot the rays that `gather` collects, of up to `count` points, for some lights at a time.

    `hit` and `free` are added to the paths of those that meet something and of the others.
    """
    lights = paths.shape[1]
    at_once = max(1, _RAYS // max(count, 1))
    most = count * min(at_once, lights)
    origin, heading = np.empty((2, most, 3), np.float32)
    place = np.empty((most, 2), np.int64)
    for low in range(0, lights, at_once):
        found = gather(low, min(low + at_once, lights), origin, heading, place)
        occluded = caster.occluded_local(origin[:found], heading[:found])
        set_paths(paths, place[:found], occluded, hit, free)


def _ball(vertices: FloatArray) -> tuple[FloatArray, float]:
    """Return a ball around vertices (V, 3)."""
    center = (vertices.min(0) + vertices.max(0)) / 2
    # Embree's float32 may reach a little farther.
    return center, 1.001 * float(np.linalg.norm(vertices - center, axis=1).max())
