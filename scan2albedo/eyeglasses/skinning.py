"""Linear blend skinning: vertices and normals carried along by weighted transforms."""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.geometry.mesh import normalized

FloatArray = NDArray[np.float64]


@overload
def skin(vertices: ArrayLike, weights: ArrayLike, transforms: ArrayLike) -> FloatArray: ...


@overload
def skin(
    vertices: ArrayLike, weights: ArrayLike, transforms: ArrayLike, normals: ArrayLike
) -> tuple[FloatArray, FloatArray]: ...


def skin(
    vertices: ArrayLike, weights: ArrayLike, transforms: ArrayLike, normals: ArrayLike | None = None
) -> FloatArray | tuple[FloatArray, FloatArray]:
    """Return vertices moved by the weighted mean of affine transforms, v' = sum over k of w_k T_k v.

    Normals turn with the inverse transpose of the mean's linear part, as if it were constant around the
    vertex: n' is parallel to B^-T n, B = sum over k of w_k A_k.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
    weights : (V, K) array_like of float
        Rows sum to 1.
    transforms : (K, 4, 4) or (K, 3, 4) array_like of float
        `deformed_from_rest` of each handle, acting on column vectors.
    normals : (V, 3) array_like of float, optional

    Returns
    -------
    (V, 3) float64, or with `normals` a tuple of two: vertices, and normals at unit length.

    Raises
    ------
    ValueError
        When shapes do not fit together, or numbers are not finite.

    Examples
    --------
    >>> lift = np.eye(4)
    >>> lift[2, 3] = 2.0
    >>> skin([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[1.0, 0.0], [0.5, 0.5]], [np.eye(4), lift])
    array([[0., 0., 0.],
           [1., 0., 1.]])
    """
    xyz, shares, maps = (np.asarray(a, np.float64) for a in (vertices, weights, transforms))
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f"vertices must have shape (V, 3), got {xyz.shape}")
    if maps.ndim != 3 or maps.shape[1:] not in ((4, 4), (3, 4)):
        raise ValueError(f"transforms must have shape (K, 4, 4) or (K, 3, 4), got {maps.shape}")
    if shares.shape != (len(xyz), len(maps)):
        raise ValueError(
            f"weights must have shape ({len(xyz)}, {len(maps)}) for {len(xyz)} vertices and {len(maps)} "
            f"transforms, got {shares.shape}"
        )
    for name, array in (("vertices", xyz), ("weights", shares), ("transforms", maps)):
        if not np.isfinite(array).all():
            bad = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(1))
            raise ValueError(f"{name} {bad[0]} is not finite ({len(bad)} of {len(array)} are not)")
    blended = (shares @ maps[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
    moved = np.einsum("vij,vj->vi", blended[:, :, :3], xyz) + blended[:, :, 3]
    if normals is None:
        return moved
    across = np.asarray(normals, np.float64)
    if across.shape != xyz.shape:
        raise ValueError(f"normals must have shape {xyz.shape} like vertices, got {across.shape}")
    return moved, normalized(_inverse_transpose_directions(blended[:, :, :3], across))


def _inverse_transpose_directions(linear: FloatArray, directions: FloatArray) -> FloatArray:
    """Return (V, 3) vectors parallel to B^-T n by the cofactors of B, which exist where B is singular too."""
    a, b, c = linear[:, :, 0], linear[:, :, 1], linear[:, :, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 2)
    mirrored = np.where(np.einsum("vi,vi->v", a, cofactors[:, :, 0]) < 0, -1.0, 1.0)
    return mirrored[:, None] * np.einsum("vij,vj->vi", cofactors, directions)
