"""Ways of light from distant lights to points: open, through lenses, or none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.lens_scene import SeenPoints
from scan2albedo.eyeglasses.lenses.light_kernels import (
    DARK,
    WAITING,
    copy_from_neighbours,
    lens_rays,
    mark_facing,
    set_paths,
    waiting_rays,
)
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import shadow_origins

Paths = NDArray[np.uint8]

_STEEPEST = 4.0
"""Greatest distance between two points of one smooth piece, in widths of the gap between their rays: the
surface is seen at 14 degrees then. Neighbours farther apart may lie on different pieces."""
_RAYS = 2**20
"""Rays that are shot at once: a bound on memory."""


@dataclass(frozen=True)
class PointStage:
    """M points whose shadows are found together."""

    point: IntArray
    """(M,)"""
    near: IntArray
    """(M, 4) points of earlier stages; where all four agree about a light, so does the point. A row with -1
    has no neighbours to ask."""


def all_at_once(count: int) -> list[PointStage]:
    """Return one stage in which each of the points is looked at by itself."""
    return [PointStage(np.arange(count), np.full((count, 4), -1))]


def pixel_stages(pixels: FloatArray, points: SeenPoints) -> list[PointStage]:
    """Return stages for points (N,) seen through pixels (N, 2), whole ones or parts of them.

    Of whole pixels a quarter is looked at first (even rows and columns), then those in the middles of four,
    then the rest. A surface's parts of one pixel follow the first of them.
    """
    cell = np.round(pixels).astype(np.int64)
    cell -= cell.min(0, initial=0) if len(cell) == 0 else cell.min(0)
    stage, near = _neighbours(cell, points.surface, points.position, points.toward_viewer, points.distance)
    return [PointStage(at, near[at]) for at in (np.flatnonzero(stage == n) for n in range(4)) if len(at)]


@njit(cache=True, nogil=True)
def _smooth(i, j, surface, position, viewer, distance):  # type: ignore[no-untyped-def]
    """Whether two points lie on one smooth piece of a surface."""
    if surface[i] != surface[j]:
        return False
    apart = between = 0.0
    for c in range(3):
        apart += (position[i, c] - position[j, c]) ** 2
        between += (viewer[i, c] - viewer[j, c]) ** 2
    return apart <= (_STEEPEST * min(distance[i], distance[j])) ** 2 * between


@njit(cache=True, nogil=True)
def _neighbours(cell, surface, position, viewer, distance):  # type: ignore[no-untyped-def]
    """Return the stage (N,) of each point, 0 to 3, and its neighbours (N, 4) of earlier stages."""
    count = cell.shape[0]
    stage, near = np.zeros(count, np.int8), np.full((count, 4), -1)
    if count == 0:
        return stage, near
    columns, rows = cell[:, 0].max() + 1, cell[:, 1].max() + 1
    first = np.full((rows, columns), -1)
    last = np.full((rows, columns), -1)
    before = np.full(count, -1)
    for i in range(count):
        column, row = cell[i]
        # Parts of a pixel follow the first of their piece, which follows none.
        j = last[row, column]
        while j >= 0:
            leader = j if near[j, 0] < 0 else near[j, 0]
            if _smooth(i, leader, surface, position, viewer, distance):
                near[i, :] = leader
                stage[i] = 3
                break
            j = before[j]
        before[i] = last[row, column]
        last[row, column] = i
        if first[row, column] < 0:
            first[row, column] = i
    for i in range(count):
        column, row = cell[i]
        even = (row % 2 == 0) + (column % 2 == 0)
        if stage[i] == 3 or even == 2:
            continue
        # Diagonal neighbours of odd pixels, direct ones of all others.
        across, down = (1, 1) if even == 0 else (1, 0)
        known = True
        for n in range(4):
            c, r = column + across, row + down
            across, down = -down, across
            if c < 0 or r < 0 or c >= columns or r >= rows:
                known = False
                break
            j = first[r, c]
            if j < 0 or not _smooth(i, j, surface, position, viewer, distance):
                known = False
                break
            near[i, n] = j
        if known:
            stage[i] = 1 if even == 0 else 2
        else:
            near[i, :] = -1
            stage[i] = 0
    return stage, near


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

    `DARK` where a surface of the `caster` is in the way, `AWAY` where the light is behind the point's own;
    otherwise 1 + the sum of 2^j over the lenses j that it passes. Rays start `offset_mm` along the normal;
    the stages hold all points, each once.
    """
    paths = np.empty((len(position), len(toward)), np.uint8)
    mark_facing(normal, toward, paths)
    start = shadow_origins(caster, position, normal, offset_mm)
    for stage in stages:
        copy_from_neighbours(stage.point, stage.near, paths)
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
    """Shoot the rays that `gather` collects, for some lights at a time.

    `hit` and `free` are added to the paths of rays that meet something and of the others.
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
