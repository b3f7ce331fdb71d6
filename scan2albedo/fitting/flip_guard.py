"""Shorten a step where it would turn a triangle over, and count turned triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.fitting.kernels import turned_faces
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.geometry.mesh import face_cross_products, vertex_normals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_HALVINGS = 8
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
    """Count triangles that look against the surface around them but did not at rest."""
    return int(np.sum(_against(vertices, faces) & ~_against(rest, faces)))


def _against(vertices: FloatArray, faces: IntArray) -> NDArray[np.bool_]:
    around = vertex_normals(vertices, faces)[faces].sum(1)
    return np.einsum("ij,ij->i", face_cross_products(vertices, faces), around) <= 0
