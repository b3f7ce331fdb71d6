"""Points of a picture in an order in which most take their shadows over from their neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.eyeglasses.lenses.lens_scene import SeenPoints

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_STEEPEST = 4.0
"""Distance between two points of one smooth piece in widths of what lies between their rays, at most: the
surface is seen at 14 degrees then. Neighbours farther apart tell nothing about each other."""


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
