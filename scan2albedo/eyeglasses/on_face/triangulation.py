"""Key points in space from labels in several views."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.pinhole import normalized_cameras
from scan2albedo.optimization.least_squares import Damping, NormalEquations, minimize

_STEPS = 50
"""Most steps a point."""
_DAMPING = Damping(first=1e-6, decrease=0.1, increase=100.0, least=1e-13, largest=1e12)
"""It begins low, for the linear start is nearly right, and stays above what rounding leaves of the matrix."""
_ENOUGH = 1e-12
"""Step over distance from the origin below which a point is done."""
_FAR = 1e300
"""Squared error, in units of the noise, of a point behind a camera."""


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
    """Return key points placed where labels in two views or more agree.

    Each point minimises, over its labels l_c,

        sum over c of rho(|project(P_c, x) - l_c|),  rho(r) = log(1 + (r / 2 s)^2),

    the Cauchy loss, under which labels many s off hardly pull. Starts are the linear solutions of all pairs
    of views that lie in front of both cameras (Hartley, Zisserman, "Multiple View Geometry", section 12.2);
    the one of least loss is refined by damped Gauss-Newton steps on the reweighted reprojection errors.

    Parameters
    ----------
    labels_2d : (C, K, 2) array_like of float
        Pixels; NaN for a missing label.
    cameras : (C, 3, 4) array_like of float
        Projection matrices, pixels from points, of any scale and sign.
    noise_px : float
        s, how far labels are usually off.

    Raises
    ------
    ValueError
        When shapes do not fit together, or `noise_px` is not positive.

    Notes
    -----
    Two views that contradict each other have no majority: the point still minimises the loss, its errors
    show it. A third view outvotes one outlier. Views from one centre see no depth: their points are NaN.

    Cost: C (C - 1) / 2 linear systems a point.

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
    pairs = [list(pair) for pair in itertools.combinations(range(len(labels)), 2)]
    starts = np.array([_linear(labels[pair], cameras[pair]) for pair in pairs])
    starts = starts[np.isfinite(starts).all(1)]
    if len(starts) == 0:
        return np.full(3, np.nan)
    nearest = starts[int(np.argmin(_loss(_residuals(starts, labels, cameras), noise_px)))]
    found = minimize(
        _Point(nearest, labels, cameras, noise_px),
        trials=_STEPS,
        step_tolerance=_ENOUGH * (1 + float(np.linalg.norm(nearest))),
        damping=_DAMPING,
    )
    return found.best.place


class _Point:
    """A place (3,) with the Cauchy loss of its labels, for `minimize`."""

    def __init__(self, place: FloatArray, labels: FloatArray, cameras: FloatArray, noise_px: float) -> None:
        self.place, self._labels, self._cameras, self._noise_px = place, labels, cameras, noise_px
        self._errors = _residuals(place[None], labels, cameras)[0]
        self.cost = float(_loss(self._errors, noise_px))

    def normal_equations(self) -> NormalEquations:
        """Return those of the reweighted squares, without cameras that have the point behind them."""
        front = np.isfinite(self._errors).all(1)
        errors, cameras = self._errors[front], self._cameras[front]
        depth = cameras[:, 2, :3] @ self.place + cameras[:, 2, 3]
        pixels = errors + self._labels[front]
        slopes = (cameras[:, :2, :3] - pixels[:, :, None] * cameras[:, 2:, :3]) / depth[:, None, None]
        weights = 1 / (1 + (errors**2).sum(1) / (2 * self._noise_px) ** 2)
        weighted = weights[:, None, None] * slopes
        return NormalEquations(
            np.einsum("cik,cim->km", weighted, slopes), np.einsum("cik,ci->k", weighted, errors)
        )

    def moved(self, step: FloatArray) -> _Point:
        """Return the place a step (3,) away."""
        return _Point(self.place + step, self._labels, self._cameras, self._noise_px)


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
