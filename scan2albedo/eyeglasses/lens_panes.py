"""Lenses that a frame's mesh holds already: parts that lie across a lens's axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.lens_plane import LensPlane
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rays import RayCaster

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_PLACES = 12
_INNER = 0.4
"""Parts are looked for on a circle of this many lens radii around the centre, and at the centre."""
_GUESS = 0.15
"""Lens radius as a part of the mesh's longest side: 0.16 to 0.2 for a front, more for a rim alone."""
_DEPTH = 0.6
"""Lens radii in front of the plane and behind it within which a part is a lens; temples are farther off."""
_ENOUGH = 0.75
"""Share of the places at which a lens is met; what crosses fewer is a strut or a nose pad."""


def without_panes(
    vertices: FloatArray, faces: IntArray, plane: LensPlane, lens_radius: float | None
) -> IntArray:
    """Return the faces (F', 3) of the parts that do not lie across the lens's axis.

    A ray in the plane meets a domed lens long before the rim. A lens of one piece with the rim stays. Without
    a `lens_radius` a small one is guessed from the mesh's size.
    """
    longest = float(np.ptp(vertices[faces.ravel()], axis=0).max())
    radius = lens_radius if lens_radius is not None else _GUESS * longest
    part = vertex_components(len(vertices), faces)[faces[:, 0]]
    kept = np.ones(len(faces), bool)
    angles = np.linspace(-np.pi, np.pi, _PLACES, endpoint=False)
    places = plane.center + _INNER * radius * np.vstack([np.zeros(3), plane.directions(angles)])
    start = places + _DEPTH * radius * plane.normal
    while kept.any():
        left = np.flatnonzero(kept)
        hits = RayCaster(vertices, faces[left]).first_hit(start, -plane.normal)
        met = hits.distance < 2 * _DEPTH * radius
        numbers, counts = np.unique(part[left[hits.face[met]]], return_counts=True)
        panes = numbers[counts >= _ENOUGH * len(places)]
        if len(panes) == 0 or not (kept & ~np.isin(part, panes)).any():
            break
        kept &= ~np.isin(part, panes)
    return faces[kept]
