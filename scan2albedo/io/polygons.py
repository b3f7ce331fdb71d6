"""Polygons of any size cut into triangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]


class Fans(NamedTuple):
    """Triangles of polygons whose corners are stored one after the other."""

    corners: IntArray
    """(T, 3) indices into the stored corners."""
    polygon: IntArray
    """(T,) polygon of each triangle."""


def fan_triangles(counts: IntArray) -> Fans:
    """Cut polygons of `counts` (P,) >= 3 corners into fans around their first corner.

    Examples
    --------
    >>> fan_triangles(np.array([3, 4])).corners.tolist()
    [[0, 1, 2], [3, 4, 5], [3, 5, 6]]
    """
    first = np.cumsum(counts) - counts
    if (counts == 3).all():
        return Fans(first[:, None] + np.arange(3), np.arange(len(counts)))
    triangles = counts - 2
    polygon = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = first[polygon]
    return Fans(np.stack([start, start + step + 1, start + step + 2], axis=1), polygon)


def cut_note(counts: IntArray) -> tuple[str, ...]:
    """Return the note that tells how many polygons were cut, if any."""
    cut = int((counts > 3).sum())
    return (f"polygons cut into triangles: {cut}",) if cut else ()
