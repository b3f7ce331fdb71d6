"""Folds of the fitted surface: steps shortened before a triangle turns over, folded triangles found."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.geometry.mesh import neighbouring_faces

MIN_STEP_COSINE = 0.2
"""A triangle whose normal turns further than that in one step counts as turning over."""
FOLD_COSINE, FOLD_CHANGE_RAD = -0.866, np.pi / 4
"""Neighbours more than 150 degrees apart: lips and nostrils crease by less, a fold-over by 180."""


def guarded(
    before: FloatArray, after: FloatArray, normals: FloatArray, samples: SurfaceSamples, faces: IntArray
) -> FloatArray:
    """Return control points (C, 3) between `before` and `after` for which no triangle turns over.

    The step is halved around each offending triangle up to seven times, then dropped there, then everywhere.
    `normals` (F, 3) are unit normals of the sampled triangles at `before`, `faces` those of the control mesh.
    """
    fraction = np.ones((len(before), 1))
    for attempt in range(9):
        trial = before + fraction * (after - before)
        bad = turned_faces(normals, samples.matrix @ trial, samples.faces, MIN_STEP_COSINE)
        if len(bad) == 0:
            return trial
        corners = np.zeros(len(before), bool)
        corners[faces[samples.parent[bad]]] = True
        corners[faces[corners[faces].any(1)]] = True
        fraction[corners] *= 0.5 if attempt < 7 else 0.0
    return before


class FoldFinder:
    """Finds triangles (F, 3) at edges of over 150 degrees, and 45 degrees more than at `rest` (V, 3)."""

    def __init__(self, rest: FloatArray, faces: IntArray) -> None:
        first, second, _ = neighbouring_faces(faces)
        self._faces, self._pairs = faces, np.stack([first, second], 1)
        angle = np.arccos(np.clip(self._cosine(rest), -1, 1))
        self._least = np.minimum(FOLD_COSINE, np.cos(np.minimum(angle + FOLD_CHANGE_RAD, np.pi)))

    def find(self, vertices: FloatArray) -> IntArray:
        """Return the indices of the folded triangles at positions (V, 3)."""
        return np.unique(self._pairs[self._cosine(vertices) < self._least])

    def _cosine(self, vertices: FloatArray) -> FloatArray:
        normals = surface_normals(vertices, self._faces)[1]
        return np.asarray(np.einsum("ij,ij->i", normals[self._pairs[:, 0]], normals[self._pairs[:, 1]]))


def turned_faces(normals: FloatArray, points: FloatArray, faces: IntArray, min_cosine: float) -> IntArray:
    """Return the faces whose normal, with vertices at `points`, turned too far from unit `normals` (F, 3)."""
    turned = surface_normals(points, faces)[1]
    cosine = np.einsum("ij,ij->i", normals, turned)
    return np.flatnonzero((cosine < min_cosine) & normals.any(1) & turned.any(1))
