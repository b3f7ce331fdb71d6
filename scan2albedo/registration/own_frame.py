"""A frame that the scan carries with it, so that the search does not see how the scan was posed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.mesh import face_cross_products
from scan2albedo.geometry.rigid import compose

FloatArray = NDArray[np.float64]


def in_own_frame(vertices: FloatArray, faces: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Move a mesh into the principal axes of its surface.

    Origin at the surface's centroid, axes along the eigenvectors of its second moments (longest first)
    and toward the heavier tail of the third moments; so the same mesh in another pose arrives at the same
    coordinates, up to rounding. Where a moment is ambiguous (a ball) any of the frames will do: the
    search covers every rotation from each.

    Parameters
    ----------
    vertices, faces : (V, 3) float64, (F, 3) int64

    Returns
    -------
    vertices : (V, 3) float64
        In the own frame.
    own_from_scan : (4, 4) float64
        The rigid transform.

    References
    ----------
    .. [1] M. Elad, A. Tal, S. Ar, "Content based retrieval of VRML objects", 2001 (pose normalisation by
       first, second and third moments).
    """
    # Differences to a vertex of the scan lose no digits however far away the origin is.
    anchor = vertices[faces[0, 0]]
    centroid = (vertices[faces].sum(1) - 3 * anchor) / 3
    area = np.linalg.norm(face_cross_products(vertices, faces), axis=1)
    total = float(area.sum())
    if total <= 0:
        return vertices - anchor, compose(np.eye(3), -anchor)
    center = area @ centroid / total
    offset = centroid - center
    _, vectors = np.linalg.eigh((offset * area[:, None]).T @ offset / total)
    axes = vectors[:, ::-1]
    tail = area @ (offset @ axes) ** 3
    axes = axes * np.where(tail < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    origin = anchor + center
    return (vertices - origin) @ axes, compose(axes.T, -axes.T @ origin)
