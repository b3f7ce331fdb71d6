"""Linear blend skinning, and the transforms of key points that it blends (supplement, section S2)."""

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.keypoints import SKELETON
from scan2albedo.geometry.mesh import normalized

PRIOR = 0.1
"""Pull of a key point's neighbours on its rotation, beside 1 for each of its bones: what turns around a
straight bone shows in no key point."""


def skin(vertices: ArrayLike, weights: ArrayLike, transforms: ArrayLike) -> FloatArray:
    """Return vertices moved by the weighted mean of affine transforms, v' = sum over k of w_k T_k v.

    Raises ValueError when shapes do not fit together, or numbers are not finite.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
    weights : (V, K) array_like of float
        Rows sum to 1.
    transforms : (K, 4, 4) or (K, 3, 4) array_like of float
        `deformed_from_rest` of each handle, acting on column vectors.

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
    if shares.shape != (wanted := (len(xyz), len(maps))):
        raise ValueError(f"weights must have shape {wanted} of vertices and transforms, got {shares.shape}")
    for name, array in (("vertices", xyz), ("weights", shares), ("transforms", maps)):
        if not np.isfinite(array).all():
            bad = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(1))
            raise ValueError(f"{name}[{bad[0]}] is not finite ({len(bad)} of {len(array)} are not)")
    blended = (shares @ maps[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
    return np.asarray(np.einsum("vij,vj->vi", blended[:, :, :3], xyz) + blended[:, :, 3])


def translations(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (K, 4, 4) translations from `source` (K, 3) to `target` (K, 3): v' = v + W (target - source)."""
    result = np.tile(np.eye(4), (len(source), 1, 1))
    result[:, :3, 3] = target - source
    return result


def turned_translations(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (K, 4, 4) rigid transforms x -> R_k (x - source_k) + target_k that follow the skeleton.

    R_k is the rotation nearest to

        sum over bones (k, j) of b_kj a_kj^T + 0.1 mean_j R_j,

    a and b the bones' unit directions before and after, by sweeps from R = 1. Bones with NaN do not count.
    """
    k, j = known_bones(source + target).T
    before, after = (normalized(points[j] - points[k]) for points in (source, target))
    turns = np.zeros((len(source), 3, 3))
    np.add.at(turns, k, after[:, :, None] * before[:, None, :])
    degree = np.bincount(k, minlength=len(source))
    turns[degree == 0] = np.eye(3)
    share = np.zeros((len(source), len(source)))
    share[k, j] = PRIOR / degree[k]
    result = np.tile(np.eye(4), (len(source), 1, 1))
    rotations = _settled_rotations(turns, share, result[:, :3, :3])
    result[:, :3, :3] = rotations
    result[:, :3, 3] = target - np.einsum("kij,kj->ki", rotations, source)
    return result


def known_bones(points: FloatArray) -> IntArray:
    """Return (B, 2) bones in both directions whose ends are finite."""
    bones = np.array(SKELETON)
    both = np.concatenate([bones, bones[:, ::-1]])
    return both[np.isfinite(points.sum(1))[both].all(1)]


@njit(cache=True, nogil=True)
def _settled_rotations(turns, share, rotations):  # type: ignore[no-untyped-def]
    """Return (K, 3, 3) rotations R_k nearest to turns_k + sum over j of share_kj R_j, up to rounding.

    Newton's step on the condition that P = M R^T be symmetric, (tr P - P) w = 2 axial(P), where it is uphill;
    a singular value decomposition elsewhere.
    """
    count = turns.shape[0]
    result = rotations.copy()
    target = np.empty((3, 3))
    for _ in range(100):
        largest = 0.0
        for k in range(count):
            target[:] = turns[k]
            for j in range(count):
                if share[k, j] != 0.0:
                    for a in range(3):
                        for b in range(3):
                            target[a, b] += share[k, j] * result[j, a, b]
            largest = max(largest, _turn_towards(target, result[k]))
        if largest <= 400 * np.finfo(np.float64).eps:
            break
    return result


@njit(cache=True, nogil=True)
def _turn_towards(m, r):  # type: ignore[no-untyped-def]
    """Turn r (3, 3) in place to the rotation nearest to m, or a step that way; return by how much."""
    p = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            p[i, j] = m[i, 0] * r[j, 0] + m[i, 1] * r[j, 1] + m[i, 2] * r[j, 2]
    wx, wy, wz = p[2, 1] - p[1, 2], p[0, 2] - p[2, 0], p[1, 0] - p[0, 1]
    a, b, c = p[1, 1] + p[2, 2], p[0, 0] + p[2, 2], p[0, 0] + p[1, 1]
    d, e, f = -0.5 * (p[0, 1] + p[1, 0]), -0.5 * (p[0, 2] + p[2, 0]), -0.5 * (p[1, 2] + p[2, 1])
    # Cofactors of the symmetric matrix [[a, d, e], [d, b, f], [e, f, c]].
    caa, cad, cae = b * c - f * f, e * f - d * c, d * f - b * e
    cbb, cbf, ccc = a * c - e * e, d * e - a * f, a * b - d * d
    determinant = a * caa + d * cad + e * cae
    scale = max(abs(a), abs(b), abs(c))
    if a > 1e-3 * scale and ccc > 1e-4 * scale**2 and determinant > 1e-5 * scale**3:
        x = (caa * wx + cad * wy + cae * wz) / determinant
        y = (cad * wx + cbb * wy + cbf * wz) / determinant
        z = (cae * wx + cbf * wy + ccc * wz) / determinant
        angle = np.sqrt(x * x + y * y + z * z)
        if angle < 0.3:
            if angle > 0.0:
                x, y, z = x / angle, y / angle, z / angle
                sine, cosine = np.sin(angle), np.cos(angle)
                for j in range(3):
                    a, b, c = r[0, j], r[1, j], r[2, j]
                    along = (1 - cosine) * (x * a + y * b + z * c)
                    r[0, j] = cosine * a + sine * (y * c - z * b) + along * x
                    r[1, j] = cosine * b + sine * (z * a - x * c) + along * y
                    r[2, j] = cosine * c + sine * (x * b - y * a) + along * z
            return angle
    u, _, vt = np.linalg.svd(m)
    if np.linalg.det(u @ vt) < 0:
        u[:, 2] = -u[:, 2]
    nearest = u @ vt
    change = np.abs(nearest - r).max()
    r[:] = nearest
    return change
