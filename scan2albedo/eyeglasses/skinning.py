"""Linear blend skinning, and the transforms of key points that it blends (supplement, section S2)."""

import numpy as np
from scipy.spatial.transform import Rotation

from scan2albedo.core.arrays import (
    EPSILON,
    ArrayLike,
    FloatArray,
    IntArray,
    checked_array,
    finite_rows,
    identities,
)
from scan2albedo.eyeglasses.keypoints import SKELETON
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rigid import procrustes

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
    maps = checked_array(transforms, ("K", "R", 4), "transforms", finite=ValueError)
    if maps.shape[1] not in (3, 4):
        raise ValueError(f"transforms must have shape (K, 4, 4) or (K, 3, 4), got {maps.shape}")
    xyz = checked_array(vertices, ("V", 3), "vertices", finite=ValueError)
    shares = checked_array(weights, (len(xyz), len(maps)), "weights", finite=ValueError)
    return moved_by(maps, shares, xyz)


def moved_by(transforms: FloatArray, weights: FloatArray, points: FloatArray) -> FloatArray:
    """Return what `skin` does of vertices (V, 3) and weights (V, K), unchecked."""
    blended = (weights @ transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
    return np.einsum("vij,vj->vi", blended[:, :, :3], points) + blended[:, :, 3]


def translations(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (K, 4, 4) translations from `source` (K, 3) to `target` (K, 3): v' = v + W (target - source)."""
    result = identities(len(source), 4)
    result[:, :3, 3] = target - source
    return result


def turned_translations(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (K, 4, 4) rigid transforms x -> R_k (x - source_k) + target_k that follow the skeleton.

    R_k is the rotation nearest to

        M_k = sum over bones (k, j) of b_kj a_kj^T + 0.1 mean_j R_j,

    a and b the bones' unit directions before and after: by sweeps from the best rotation of all points, then
    by Newton's steps to where `turn_conditions` are symmetric. Bones with NaN do not count.
    """
    bones, known = known_bones(source + target), finite_rows(source + target)
    k, j = bones.T
    before, after = (normalized(points[j] - points[k]) for points in (source, target))
    own = np.zeros((len(source), 3, 3))
    np.add.at(own, k, after[:, :, None] * before[:, None, :])
    own[np.bincount(k, minlength=len(own)) == 0] = np.eye(3)
    rotations = np.tile(procrustes(source[known], target[known])[:3, :3], (len(source), 1, 1))
    for _ in range(100):
        drawn = own.copy()
        np.add.at(drawn, k, _prior(k)[:, None, None] * rotations[j])
        u, _, vt = np.linalg.svd(drawn)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        moved, rotations = np.abs(u @ vt - rotations).max(), u @ vt
        if moved < 1 / 20:
            break
    for _ in range(30):
        pulls, system = turn_conditions(rotations, before, after, bones)
        off = np.stack([pulls[:, m, n] - pulls[:, n, m] for m, n in ((2, 1), (0, 2), (1, 0))], 1)
        turn = np.linalg.solve(system, off.ravel()).reshape(-1, 3)
        rotations = Rotation.from_rotvec(turn).as_matrix() @ rotations
        # The next step would be about the square of this one.
        if np.abs(turn).max() < np.sqrt(EPSILON):
            break
    result = translations(np.einsum("kij,kj->ki", rotations, source), target)
    result[:, :3, :3] = rotations
    return result


def turn_conditions(
    rotations: FloatArray, before: FloatArray, after: FloatArray, bones: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return P_k = M_k R_k^T (K, 3, 3), and what turns w_k (rad) from the left change (3 K, 3 K).

    R_k maximises trace(R_k^T M_k), M_k as in `turned_translations`, where P_k is symmetric. With
    Q_kj = 0.1 mean_j R_j R_k^T it becomes so, to first order, by turns that solve

        (tr P_k - P_k) w_k - sum over j of (tr Q_kj - Q_kj) w_j = 2 axial(P_k).

    `before` and `after` (B, 3) are the unit directions of the `bones` (B, 2).
    """
    (k, j), count = bones.T, len(rotations)
    relative = _prior(k)[:, None, None] * (rotations[j] @ rotations[k].transpose(0, 2, 1))
    carried = np.einsum("bij,bj->bi", rotations[k], before)
    pulls = np.zeros((count, 3, 3))
    np.add.at(pulls, k, after[:, :, None] * carried[:, None] + relative)
    # A key point without bones does not turn.
    pulls[np.bincount(k, minlength=count) == 0] = np.eye(3)
    system = np.zeros((count, count, 3, 3))
    # Damped: nothing fixes how a straight temple without its hinge is turned about itself.
    system[np.arange(count), np.arange(count)] = _spin(pulls) + np.sqrt(EPSILON) * np.eye(3)
    np.add.at(system, (k, j), -_spin(relative))
    return pulls, system.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)


def _prior(k: IntArray) -> FloatArray:
    return PRIOR / np.bincount(k)[k]


def _spin(matrices: FloatArray) -> FloatArray:
    return np.trace(matrices, axis1=1, axis2=2)[:, None, None] * np.eye(3) - matrices


def known_bones(points: FloatArray) -> IntArray:
    """Return (B, 2) bones in both directions whose ends are finite."""
    bones = np.array(SKELETON)
    both = np.concatenate([bones, bones[:, ::-1]])
    return both[np.isfinite(points.sum(1))[both].all(1)]
