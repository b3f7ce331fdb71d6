"""Meshes whose corners have places on a texture: a vertex for each place, so that seams come apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class SplitMesh:
    """A mesh with one place for each of its N vertices.

    `vertex` (N,) are the vertices that they were, `uv` (N, 2) the places, `faces` (F, 3) refer to the N.
    """

    vertex: IntArray
    uv: FloatArray
    faces: IntArray


def split_at_seams(faces: IntArray, uv: FloatArray, side: IntArray | None = None) -> SplitMesh:
    """Return a mesh with faces (F, 3) and places of their corners `uv` (F, 3, 2), split where places differ.

    Faces with another number in `side` (F,) come apart as well.

    >>> faces, uv = np.array([[0, 1, 2], [2, 1, 3]]), np.zeros((2, 3, 2))
    >>> uv[1, 0] = 1.0
    >>> split_at_seams(faces, uv).vertex.tolist()
    [0, 1, 2, 2, 3]
    """
    # One number for a vertex and its place in the texture; that two such numbers agree is next to impossible.
    place = np.round(uv * 2**20).astype(np.int64)
    across, up = place[..., 0] * 0xC2B2AE3D27D4EB5, place[..., 1] * 0x165667B19E3779F
    key = faces * 0x9E3779B97F4A7C1 + across + up
    if side is not None:
        key += side[:, None] * 0x27D4EB2F165667C5
    _, first, corner = np.unique(key, return_index=True, return_inverse=True)
    order = np.lexsort((first, faces.ravel()[first]))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    kept = first[order]
    return SplitMesh(
        faces.ravel()[kept].astype(np.int64), uv.reshape(-1, 2)[kept], rank[corner.reshape(faces.shape)]
    )
