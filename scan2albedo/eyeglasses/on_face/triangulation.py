"""Key points in space from labels in several views."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from scan2albedo.geometry.pinhole import normalized_cameras

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


_STEPS = 50
"""Most steps a point."""
_DAMPING = 1e-6
"""First damping, as a part of the normal matrix's diagonal: the linear start is nearly right."""
_ENOUGH = 1e-12
"""Step over distance from the origin below which a point is done."""
_FAR = 1e300
"""Squared error, in those of the noise, of what lies behind a camera."""


@dataclass(frozen=True)
class TriangulatedPoints:
    """K points from C views; see `triangulate`."""

    points: FloatArray
    """(K, 3) in the unit of the cameras; NaN rows where fewer than two views see a point."""
    errors_px: FloatArray
    """(C, K) distances of labels from the reprojected points; NaN where a label or a point is missing,
    infinite where a point lies behind the camera."""
    inliers: BoolArray
    """(C, K) labels within three times the noise of their point."""


def triangulate(labels_2d: ArrayLike, cameras: ArrayLike, *, noise_px: float = 2.0) -> TriangulatedPoints:
    """Place key points where labels in two views or more agree.

    Each point minimises, over its labels l_c,

        sum over c of rho(|project(P_c, x) - l_c|),  rho(r) = log(1 + (r / 2 s)^2),

    the Cauchy loss, under which labels many s off hardly pull. Starts are the linear solutions of all
    pairs of views that lie in front of both cameras; the one of least loss is refined by damped Gauss-Newton
    steps on the reweighted reprojection errors.

    Parameters
    ----------
    labels_2d : (C, K, 2) array_like of float
        Pixels; NaN for a missing label.
    cameras : (C, 3, 4) array_like of float
        Projection matrices, pixels from points, of any scale and sign.
    noise_px : float
        s, how far labels are usually off.

    Returns
    -------
    TriangulatedPoints

    Raises
    ------
    ValueError
        When shapes do not fit together, or `noise_px` is not positive.

    Notes
    -----
    Two views that contradict each other have no majority: the point still minimises the loss, its errors
    tell. A third view outvotes one outlier. Views from one centre see no depth: their points are NaN.

    Cost: C (C - 1) / 2 linear systems a point.

    References
    ----------
    .. [1] R. Hartley, A. Zisserman, "Multiple View Geometry", 2004, section 12.2.

    Examples
    --------
    >>> cameras = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0]] for x in (0.0, -1.0)]
    >>> found = triangulate([[[0.1, 0.2]], [[0.0, 0.2]]], cameras, noise_px=0.01)
    >>> found.points.round(6).tolist()
    [[1.0, 2.0, 10.0]]
    """
    labels, matrices = _checked(labels_2d, cameras, noise_px)
    count = labels.shape[1]
    points = np.full((count, 3), np.nan)
    errors = np.full(labels.shape[:2], np.nan)
    for k in range(count):
        seen = np.flatnonzero(np.isfinite(labels[:, k]).all(1))
        if len(seen) < 2:
            continue
        points[k] = _place(labels[seen, k], matrices[seen], noise_px)
        if np.isfinite(points[k]).all():
            residual = _residuals(points[k][None], labels[seen, k], matrices[seen])[0]
            errors[seen, k] = np.linalg.norm(residual, axis=-1)
    with np.errstate(invalid="ignore"):
        inliers = errors <= 3 * noise_px
    return TriangulatedPoints(points, errors, inliers)


def _checked(labels_2d: ArrayLike, cameras: ArrayLike, noise_px: float) -> tuple[FloatArray, FloatArray]:
    labels, matrices = np.asarray(labels_2d, np.float64), normalized_cameras(cameras)
    if labels.ndim != 3 or labels.shape[2] != 2:
        raise ValueError(f"labels_2d must have shape (C, K, 2), got {labels.shape}")
    if len(matrices) != len(labels):
        raise ValueError(f"cameras must have shape ({len(labels)}, 3, 4), got {matrices.shape}")
    if not noise_px > 0:
        raise ValueError(f"noise_px must be > 0, got {noise_px}")
    return labels, matrices


def _place(labels: FloatArray, cameras: FloatArray, noise_px: float) -> FloatArray:
    """Return the point (3,) of labels (C, 2), NaN where no pair of views gives one."""
    starts = np.array([_linear(labels[[a, b]], cameras[[a, b]]) for a, b in _pairs(len(labels))])
    starts = starts[np.isfinite(starts).all(1)]
    if len(starts) == 0:
        return np.full(3, np.nan)
    x = starts[int(np.argmin(_loss(_residuals(starts, labels, cameras), noise_px)))]
    refined: FloatArray = _refined(x, labels, cameras, float(noise_px))
    return refined


def _pairs(count: int) -> list[tuple[int, int]]:
    return list(itertools.combinations(range(count), 2))


def _linear(labels: FloatArray, cameras: FloatArray) -> FloatArray:
    """Return the point (3,) of the linear equations u (p3 x) = p1 x, v (p3 x) = p2 x; NaN behind a camera."""
    rows = (labels[:, :, None] * cameras[:, 2:] - cameras[:, :2]).reshape(-1, 4)
    # Rays, not pixels: each row as a plane of unit normal.
    rows = rows / np.maximum(np.linalg.norm(rows[:, :3], axis=1, keepdims=True), 1e-300)
    solution, _, rank, _ = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=1e-9)
    depth = cameras[:, 2, :3] @ solution + cameras[:, 2, 3]
    return solution if rank == 3 and (depth > 0).all() else np.full(3, np.nan)


def _residuals(points: FloatArray, labels: FloatArray, cameras: FloatArray) -> FloatArray:
    """Return (H, C, 2) reprojected points (H, 3) minus labels (C, 2); infinite behind a camera."""
    image = np.einsum("cij,hj->hci", cameras[:, :, :3], points) + cameras[:, :, 3]
    depth = image[..., 2:]
    front = depth > 0
    return np.where(front, image[..., :2] / np.where(front, depth, 1.0) - labels, np.inf)


def _loss(residuals: FloatArray, noise_px: float) -> FloatArray:
    square = (residuals**2).sum(-1) / (2 * noise_px) ** 2
    return np.log1p(np.minimum(square, _FAR)).sum(-1)


@njit(cache=True, nogil=True, error_model="numpy")
def _refined(x, labels, cameras, noise_px):  # type: ignore[no-untyped-def]
    """Return the point (3,) after reweighted Levenberg-Marquardt steps that each lower the loss."""
    loss, damping = _point_loss(x, labels, cameras, noise_px), _DAMPING
    for _ in range(_STEPS):
        normal, gradient = _normal_equations(x, labels, cameras, noise_px)
        for k in range(3):
            normal[k, k] *= 1 + damping
        step = _solved(normal, gradient)
        trial = x - step
        lower = _point_loss(trial, labels, cameras, noise_px)
        if lower < loss:
            x, loss, damping = trial, lower, damping / 10
        else:
            damping *= 100
        if damping > 1e12 or not np.sum(step**2) > (_ENOUGH * (1 + np.sqrt(np.sum(x**2)))) ** 2:
            break
    return x


@njit(cache=True, nogil=True, error_model="numpy")
def _point_loss(x, labels, cameras, noise_px):  # type: ignore[no-untyped-def]
    """Return the sum of the Cauchy losses; what lies behind a camera counts as far off."""
    loss = 0.0
    for c in range(len(cameras)):
        u, v, depth = _image(x, cameras[c])
        square = _FAR
        if depth > 0:
            dx, dy = u / depth - labels[c, 0], v / depth - labels[c, 1]
            square = min((dx * dx + dy * dy) / (2 * noise_px) ** 2, _FAR)
        loss += np.log1p(square)
    return loss


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(x, labels, cameras, noise_px):  # type: ignore[no-untyped-def]
    """Return the matrix (3, 3) and the gradient (3,) of the reweighted squares."""
    normal, gradient, slope = np.zeros((3, 3)), np.zeros(3), np.empty(3)
    for c in range(len(cameras)):
        u, v, depth = _image(x, cameras[c])
        if not depth > 0:
            continue
        u, v = u / depth, v / depth
        dx, dy = u - labels[c, 0], v - labels[c, 1]
        weight = 1 / (1 + (dx * dx + dy * dy) / (2 * noise_px) ** 2)
        for axis, place, error in ((0, u, dx), (1, v, dy)):
            for k in range(3):
                slope[k] = (cameras[c, axis, k] - place * cameras[c, 2, k]) / depth
            for k in range(3):
                gradient[k] += weight * slope[k] * error
                for m in range(3):
                    normal[k, m] += weight * slope[k] * slope[m]
    return normal, gradient


@njit(cache=True, nogil=True)
def _image(x, camera):  # type: ignore[no-untyped-def]
    """Return the homogeneous pixel of a point."""
    u, v, depth = camera[0, 3], camera[1, 3], camera[2, 3]
    for k in range(3):
        u += camera[0, k] * x[k]
        v += camera[1, k] * x[k]
        depth += camera[2, k] * x[k]
    return u, v, depth


@njit(cache=True, nogil=True, error_model="numpy")
def _solved(matrix, right):  # type: ignore[no-untyped-def]
    """Return the solution (3,) of a positive definite system by Cramer's rule, 0 where it is singular."""
    minors, step = np.empty((3, 3)), np.zeros(3)
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            minors[i, j] = matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]
    determinant = matrix[0, 0] * minors[0, 0] + matrix[0, 1] * minors[0, 1] + matrix[0, 2] * minors[0, 2]
    if determinant > 0:
        for i in range(3):
            for j in range(3):
                step[i] += minors[j, i] * right[j] / determinant
    return step
