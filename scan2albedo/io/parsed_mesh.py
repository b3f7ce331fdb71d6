"""`ParsedMesh`, what a file reader hands to `load_scan`, and polygons cut into triangles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ScanError
from scan2albedo.io import limits


@dataclass(frozen=True)
class Material:
    """One surface material; its base colour shows where it has no texture (H, W, 3), or none was found.

    A texture (H, W, 4) has alpha, which is 0 where no picture showed the surface. `uv_placement` is
    the scale (2) and the offset (2) with which coordinates look it up.
    """

    name: str
    texture_linear: NDArray[np.float32] | None = None
    base_color_linear: tuple[float, float, float] = (0.5, 0.5, 0.5)
    uv_placement: tuple[float, ...] = (1, 1, 0, 0)


@dataclass(frozen=True)
class ParsedMesh:
    """Geometry and appearance as they stand in a file, in file units.

    `vertices` (V, 3); `faces` (F, 3), not yet checked against them; `uv` (F, 3, 2), NaN at corners without
    texture coordinates, v = 0 the bottom row; `material` (F,) indices into `materials`, -1 for none, all 0
    when omitted and there are materials; `vertex_color_linear` (V, 3), or with alpha (V, 4).
    """

    vertices: FloatArray
    faces: IntArray
    uv: FloatArray | None = None
    material: IntArray | None = None
    materials: tuple[Material, ...] = ()
    vertex_color_linear: NDArray[np.float32] | None = None
    notes: tuple[str, ...] = ()


def fan_triangles(counts: IntArray) -> tuple[IntArray, IntArray]:
    """Cut polygons of `counts` (P,) >= 3 corners, stored one after the other, into fans at their first ones.

    Returns the triangles (T, 3) as indices into the stored corners, and the polygon (T,) of each.

    >>> fan_triangles(np.array([3, 4]))[0].tolist()
    [[0, 1, 2], [3, 4, 5], [3, 5, 6]]
    """
    first = np.cumsum(counts) - counts
    if (counts == 3).all():
        return first[:, None] + np.arange(3), np.arange(len(counts))
    triangles = counts - 2
    polygon = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = first[polygon]
    return np.stack([start, start + step + 1, start + step + 2], axis=1), polygon


def require_few_triangles(name: str, counts: IntArray) -> None:
    """Raise TooLargeError when polygons of `counts` (P,) corners give too many triangles."""
    triangles = int(counts.sum()) - 2 * len(counts)
    limits.require_at_most(name, "triangles", triangles, limits.TRIANGLES, "decimate it")


def cut_note(counts: IntArray) -> tuple[str, ...]:
    """Return a note on how many polygons were cut, if any."""
    cut = int((counts > 3).sum())
    return (f"polygons cut into triangles: {cut}",) if cut else ()


def damaged(path: Path, what: str) -> ScanError:
    """Return the error for a file that is not a whole one of the kind that its name ends with."""
    kind = path.suffix[1:].upper()
    return ScanError(f"{path.name}: {what}; the file is damaged, truncated or no {kind}: export it again")
