"""Shorten a step where it would turn a triangle over, and count turned triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.fitting.kernels import turned_faces
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.geometry.mesh import face_normals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_HALVINGS = 8
FOLD_COSINE = -0.866
"""Neighbours more than 150 degrees apart: lips and nostrils crease by less, a fold-over by 180."""
MIN_STEP_COSINE = 0.2
"""A triangle whose normal turns further than this in one step counts as turning over."""


def guarded(
    before: FloatArray,
    after: FloatArray,
    face_normals: FloatArray,
    samples: SurfaceSamples,
    control_faces: IntArray,
) -> FloatArray:
    """Return control points (C, 3) between `before` and `after` for which no triangle turns over.

    The step is halved at the control points around each offending triangle and their neighbours, up to
    MAX_HALVINGS times, then dropped there, then dropped everywhere.

    Parameters
    ----------
    before, after : (C, 3) float64
    face_normals : (F, 3) float64
        Unit normals of the sampled triangles at `before`.
    samples : SurfaceSamples
    control_faces : (F_C, 3) int64
    """
    fraction = np.ones((len(before), 1))
    for attempt in range(MAX_HALVINGS + 1):
        trial = before + fraction * (after - before)
        bad = turned_faces(face_normals, samples.matrix @ trial, samples.faces, MIN_STEP_COSINE)
        if len(bad) == 0:
            return trial
        corners = np.zeros(len(before), bool)
        corners[control_faces[samples.parent[bad]]] = True
        corners[control_faces[corners[control_faces].any(1)]] = True
        fraction[corners] *= 0.5 if attempt < MAX_HALVINGS - 1 else 0.0
    return before


def flipped_faces(vertices: FloatArray, rest: FloatArray, faces: IntArray) -> int:
    """Count triangles at edges folded by more than 150 degrees that were not folded so at rest."""
    pairs = _neighbours(faces)
    folded = _folded(vertices, faces, pairs) & ~_folded(rest, faces, pairs)
    return len(np.unique(pairs[folded]))


def _folded(vertices: FloatArray, faces: IntArray, pairs: IntArray) -> NDArray[np.bool_]:
    normals = face_normals(vertices, faces)
    return np.asarray(np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]) < FOLD_COSINE)


def _neighbours(faces: IntArray) -> IntArray:
    """Return (E, 2) pairs of faces that share an edge."""
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    keys = directed.min(1) * (np.int64(faces.max()) + 1) + directed.max(1)
    order = np.argsort(keys, kind="stable")
    shared = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    return np.stack([order[shared], order[shared + 1]], 1) // 3
