"""`ParsedMesh`: what a file reader hands to `load_scan`, before repairs, units and texture packing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
