"""Shorten a step where it would turn a triangle over, and count turned triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.geometry.mesh import face_cross_products, normalized, vertex_normals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_HALVINGS = 8
MIN_STEP_COSINE = 0.2
"""A triangle whose normal turns further than this in one step counts as turning over."""


def guarded(
    before: FloatArray, after: FloatArray, samples: SurfaceSamples, control_faces: IntArray
) -> FloatArray:
    """Return control points (C, 3) between `before` and `after` for which no triangle turns over.

    The step is halved at the control points around each offending triangle and their neighbours, up to
    MAX_HALVINGS times, then everywhere, then dropped.
    """
    start = face_cross_products(samples.matrix @ before, samples.faces)
    fraction = np.ones(len(before))
    for _ in range(MAX_HALVINGS):
        trial = before + fraction[:, None] * (after - before)
        bad = _turned(start, face_cross_products(samples.matrix @ trial, samples.faces))
        if not bad.any():
            return trial
        corners = np.zeros(len(before), bool)
        corners[control_faces[samples.parent[bad]]] = True
        around = corners[control_faces].any(1)
        corners[control_faces[around]] = True
        fraction[corners] *= 0.5
    half = before + 0.5 * fraction.min() * (after - before)
    turned = _turned(start, face_cross_products(samples.matrix @ half, samples.faces))
    return before if turned.any() else half


def _turned(before: FloatArray, after: FloatArray) -> NDArray[np.bool_]:
    cosine = np.einsum("ij,ij->i", normalized(before), normalized(after))
    return (cosine < MIN_STEP_COSINE) & (np.abs(before).sum(1) > 0)


def flipped_faces(vertices: FloatArray, rest: FloatArray, faces: IntArray) -> int:
    """Count triangles that look against the surface around them but did not at rest."""
    return int(np.sum(_against(vertices, faces) & ~_against(rest, faces)))


def _against(vertices: FloatArray, faces: IntArray) -> NDArray[np.bool_]:
    around = vertex_normals(vertices, faces)[faces].sum(1)
    return np.einsum("ij,ij->i", face_cross_products(vertices, faces), around) <= 0
