"""`ParsedMesh`, what a file reader hands to `load_scan`, and polygons cut into triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Material:
    """One surface material.

    Parameters
    ----------
    name : str
    texture_linear : (H, W, 3) float32, optional
        None when the material has no texture, or its file is missing.
    base_color_linear : (float, float, float)
        Colour where there is no texture.
    """

    name: str
    texture_linear: NDArray[np.float32] | None = None
    base_color_linear: tuple[float, float, float] = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class ParsedMesh:
    """Geometry and appearance as they stand in a file, in file units.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int64
        Not yet checked against `vertices`.
    uv : (F, 3, 2) float64, optional
        NaN at corners without texture coordinates; v = 0 is the bottom row.
    material : (F,) int64, optional
        Index into `materials`; -1 = none. All 0 when omitted and there are materials.
    materials : tuple of Material
    vertex_color_linear : (V, 3) float32, optional
    notes : tuple of str
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    material: NDArray[np.int64] | None = None
    materials: tuple[Material, ...] = ()
    vertex_color_linear: NDArray[np.float32] | None = None
    notes: tuple[str, ...] = ()


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
    """Return a note on how many polygons were cut, if any."""
    cut = int((counts > 3).sum())
    return (f"polygons cut into triangles: {cut}",) if cut else ()
