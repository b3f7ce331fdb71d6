"""A lattice spacing that suits a mesh: as fine as its thin parts ask for, as coarse as memory asks for."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.weighting.options import WeightOptions
from scan2albedo.geometry.mesh import face_areas, face_normals
from scan2albedo.geometry.rays import RayCaster

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SAMPLES = 2000
_SKIN = 1e-5
"""Rays start this part of the size off the surface, so that float32 does not find the face itself."""


def thickness(vertices: FloatArray, faces: IntArray, part: float) -> float:
    """Return the thickness, in the mesh's unit, that `part` of the surface's area stays below.

    Measured across the faces at 2,000 places spread evenly over the area, on the side where the mesh is
    met first: winding does not matter, and a narrow gap counts like a thin part. Infinite where no ray meets
    anything.
    """
    area = np.cumsum(face_areas(vertices, faces))
    if not area[-1] > 0:
        return math.inf
    chosen = np.searchsorted(area, (np.arange(_SAMPLES) + 0.5) / _SAMPLES * area[-1])
    caster = RayCaster(vertices, faces)
    center, normal = vertices[faces[chosen]].mean(1), face_normals(vertices, faces[chosen])
    skin = _SKIN * caster.size
    sides = [caster.first_hit(center + skin * way, way).distance + skin for way in (normal, -normal)]
    return float(np.quantile(np.minimum(*sides), part, method="lower"))


def spacing_wanted(
    vertices: FloatArray, faces: IntArray, size: float, closest: float, options: WeightOptions
) -> tuple[int, str]:
    """Return into how many parts the size is to be divided, and why.

    A whole number of parts, so that rounding in another unit does not change the lattice.

    Parameters
    ----------
    size : float
        In the mesh's unit.
    closest : float
        Least spacing that two key points ask for, in the mesh's unit: they must not share a node.
    """
    thin = thickness(vertices, faces, options.thin_part)
    spacing = float(np.clip(thin, options.finest * size, options.coarsest * size))
    reason = f"the mesh's thin parts measure {thin:.4g}"
    if closest < spacing:
        spacing, reason = closest, "two key points are close together"
    return math.ceil(size / spacing * (1 - 1e-9)), reason
