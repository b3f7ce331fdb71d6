"""A frame that the scan carries with it, so that the search does not see how the scan was posed."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
    total, center, second = _first_and_second_moments(vertices, faces, anchor)
    if total <= 0:
        return vertices - anchor, compose(np.eye(3), -anchor)
    origin = anchor + center
    _, vectors = np.linalg.eigh(second)
    axes = np.ascontiguousarray(vectors[:, ::-1])
    axes = axes * np.where(_third_moments(vertices, faces, origin, axes) < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return (vertices - origin) @ axes, compose(axes.T, -axes.T @ origin)


@njit(cache=True, nogil=True)
def _first_and_second_moments(vertices, faces, anchor):  # type: ignore[no-untyped-def]
    """Return area, centroid relative to the anchor, and covariance of the faces' centroids, by area."""
    total, center, second = 0.0, np.zeros(3), np.zeros((3, 3))
    middle = np.empty(3)
    for f in range(faces.shape[0]):
        area = _place(vertices, faces[f], anchor, middle)
        total += area
        for i in range(3):
            center[i] += area * middle[i]
            for j in range(3):
                second[i, j] += area * middle[i] * middle[j]
    if total <= 0:
        return total, center, second
    center /= total
    return total, center, second / total - np.outer(center, center)


@njit(cache=True, nogil=True)
def _third_moments(vertices, faces, origin, axes):  # type: ignore[no-untyped-def]
    """Return (3,) sums of area times the cube of the centroid's coordinate along each axis."""
    third, middle = np.zeros(3), np.empty(3)
    for f in range(faces.shape[0]):
        area = _place(vertices, faces[f], origin, middle)
        for axis in range(3):
            along = middle[0] * axes[0, axis] + middle[1] * axes[1, axis] + middle[2] * axes[2, axis]
            third[axis] += area * along * along * along
    return third


@njit(cache=True, nogil=True)
def _place(vertices, face, origin, middle):  # type: ignore[no-untyped-def]
    """Fill in a face's centroid relative to the origin and return its area."""
    a, b, c = face[0], face[1], face[2]
    ux, uy, uz = (
        vertices[b, 0] - vertices[a, 0],
        vertices[b, 1] - vertices[a, 1],
        vertices[b, 2] - vertices[a, 2],
    )
    vx, vy, vz = (
        vertices[c, 0] - vertices[a, 0],
        vertices[c, 1] - vertices[a, 1],
        vertices[c, 2] - vertices[a, 2],
    )
    for i in range(3):
        at = origin[i]
        middle[i] = ((vertices[a, i] - at) + (vertices[b, i] - at) + (vertices[c, i] - at)) / 3
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return 0.5 * np.sqrt(x * x + y * y + z * z)
