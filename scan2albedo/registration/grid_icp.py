"""Thousands of small robust ICPs at once, on a voxel grid that knows the nearest scan sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.oriented_points import OrientedPoints

_MAX_CELLS = 1_500_000


@dataclass(frozen=True)
class NearestGrid:
    """A voxel grid over a point cloud (mm).

    `nearest` (X, Y, Z) holds the index of (nearly) the nearest sample to each cell's centre, `origin` (3,) is
    the corner of cell (0, 0, 0), `cell_mm` the side of a cell.
    """

    samples: OrientedPoints
    nearest: NDArray[np.int32]
    origin: FloatArray
    cell_mm: float

    @classmethod
    def of(cls, samples: OrientedPoints, *, cell_mm: float, margin_mm: float) -> NearestGrid:
        """Build the grid over the samples' box widened by `margin_mm`; huge boxes get larger cells."""
        low, high = samples.points.min(0) - margin_mm, samples.points.max(0) + margin_mm
        cell = max(cell_mm, float(np.cbrt(np.prod(high - low) / _MAX_CELLS)))
        shape = np.ceil((high - low) / cell).astype(np.int64) + 1
        nearest = _nearest_by_sweeps(samples.points, low, cell, shape[0], shape[1], shape[2])
        return cls(samples, nearest, low, cell)

    def nearest_samples(self, points: FloatArray) -> IntArray:
        """Return the index of (nearly) the nearest sample of each (N, 3) point, -1 outside the grid."""
        cell = np.floor((points - self.origin) / self.cell_mm).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < np.array(self.nearest.shape)), axis=1)
        x, y, z = np.where(inside[:, None], cell, 0).T
        return np.where(inside, self.nearest[x, y, z], -1)


@njit(cache=True, nogil=True)
def _nearest_by_sweeps(points, origin, cell, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Vector distance transform: nearest points spread to neighbours in eight ordered sweeps."""
    nearest = np.full((nx, ny, nz), -1, np.int32)
    squared = np.full((nx, ny, nz), np.inf)
    for p in range(points.shape[0]):
        i = int((points[p, 0] - origin[0]) / cell)
        j = int((points[p, 1] - origin[1]) / cell)
        k = int((points[p, 2] - origin[2]) / cell)
        dx = points[p, 0] - origin[0] - (i + 0.5) * cell
        dy = points[p, 1] - origin[1] - (j + 0.5) * cell
        dz = points[p, 2] - origin[2] - (k + 0.5) * cell
        d = dx * dx + dy * dy + dz * dz
        if d < squared[i, j, k]:
            squared[i, j, k] = d
            nearest[i, j, k] = p
    for sweep in range(8):
        si = 1 if sweep & 1 else -1
        sj = 1 if sweep & 2 else -1
        sk = 1 if sweep & 4 else -1
        for a in range(nx):
            i = a if si > 0 else nx - 1 - a
            for b in range(ny):
                j = b if sj > 0 else ny - 1 - b
                for c in range(nz):
                    k = c if sk > 0 else nz - 1 - c
                    for axis in range(3):
                        u = i - si if axis == 0 else i
                        v = j - sj if axis == 1 else j
                        w = k - sk if axis == 2 else k
                        if u < 0 or v < 0 or w < 0 or u >= nx or v >= ny or w >= nz:
                            continue
                        p = nearest[u, v, w]
                        if p < 0 or p == nearest[i, j, k]:
                            continue
                        dx = points[p, 0] - origin[0] - (i + 0.5) * cell
                        dy = points[p, 1] - origin[1] - (j + 0.5) * cell
                        dz = points[p, 2] - origin[2] - (k + 0.5) * cell
                        d = dx * dx + dy * dy + dz * dz
                        if d < squared[i, j, k]:
                            squared[i, j, k] = d
                            nearest[i, j, k] = p
    return nearest


def refine_on_grid(
    grid: NearestGrid,
    model: OrientedPoints,
    weights: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
    *,
    iterations: int,
    sigma_mm: tuple[float, float],
) -> FloatArray:
    """Run a robust ICP of the (M,) model samples from every start; poses change in place.

    Minimises, per start, sum_i w_i rho_i (n_i . (R p_i + t - q_i))^2 plus a tenth of the point-to-point term,
    where q_i is the scan sample nearest to R p_i + t, n_i the mean of both normals [1]_, and rho_i falls with
    distance (Geman-McClure, scale sigma, geometric between the two of `sigma_mm`) and with the normals'
    angle.

    `grid` is the scan's, `weights` (M,); `rotations` (N, 3, 3) and `translations` (N, 3), `scan_from_model`,
    are overwritten. Returns (N,) scores at the final poses with the last scale: the weighted mean of rho_i, 0
    (nothing near) ... 1.

    .. [1] S. Rusinkiewicz, "A symmetric objective function for ICP", SIGGRAPH 2019 (mean normals).
    """
    scores = np.zeros(len(rotations))
    _refine_all(
        grid.nearest,
        grid.origin,
        grid.cell_mm,
        grid.samples.points,
        grid.samples.normals,
        model.points,
        model.normals,
        weights / weights.sum(),
        rotations,
        translations,
        iterations,
        sigma_mm[0],
        sigma_mm[1],
        scores,
    )
    return scores


@njit(cache=True, nogil=True)
def _refine_all(  # type: ignore[no-untyped-def]
    nearest, origin, cell, q, qn, p, pn, weights, rotations, translations, iterations, first, last, scores
):
    normal_matrix, gradient, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for start in range(rotations.shape[0]):
        rotation, translation = rotations[start], translations[start]
        for iteration in range(iterations):
            fraction = iteration / max(iterations - 1, 1)
            sigma = first * (last / first) ** fraction
            _linearize(
                nearest, origin, cell, q, qn, p, pn, weights, rotation, translation, sigma,
                normal_matrix, gradient,
            )  # fmt: skip
            if not _solve6(normal_matrix, gradient, step):
                break
            _move(rotation, translation, step)
        scores[start] = _linearize(
            nearest, origin, cell, q, qn, p, pn, weights, rotation, translation, last,
            normal_matrix, gradient,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _linearize(  # type: ignore[no-untyped-def]
    nearest, origin, cell, q, qn, p, pn, weights, rotation, translation, sigma, normal_matrix, gradient
):
    normal_matrix[:] = 0.0
    gradient[:] = 0.0
    score = 0.0
    row = np.zeros(6)
    nx, ny, nz = nearest.shape
    for m in range(p.shape[0]):
        # x is the rotated point, about whose translation the small rotation is taken.
        x0 = rotation[0, 0] * p[m, 0] + rotation[0, 1] * p[m, 1] + rotation[0, 2] * p[m, 2]
        x1 = rotation[1, 0] * p[m, 0] + rotation[1, 1] * p[m, 1] + rotation[1, 2] * p[m, 2]
        x2 = rotation[2, 0] * p[m, 0] + rotation[2, 1] * p[m, 1] + rotation[2, 2] * p[m, 2]
        i = int(np.floor((x0 + translation[0] - origin[0]) / cell))
        j = int(np.floor((x1 + translation[1] - origin[1]) / cell))
        k = int(np.floor((x2 + translation[2] - origin[2]) / cell))
        if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
            continue
        s = nearest[i, j, k]
        n0 = rotation[0, 0] * pn[m, 0] + rotation[0, 1] * pn[m, 1] + rotation[0, 2] * pn[m, 2]
        n1 = rotation[1, 0] * pn[m, 0] + rotation[1, 1] * pn[m, 1] + rotation[1, 2] * pn[m, 2]
        n2 = rotation[2, 0] * pn[m, 0] + rotation[2, 1] * pn[m, 1] + rotation[2, 2] * pn[m, 2]
        agreement = n0 * qn[s, 0] + n1 * qn[s, 1] + n2 * qn[s, 2]
        if agreement <= 0.0:
            continue
        e0 = x0 + translation[0] - q[s, 0]
        e1 = x1 + translation[1] - q[s, 1]
        e2 = x2 + translation[2] - q[s, 2]
        near = sigma * sigma / (sigma * sigma + e0 * e0 + e1 * e1 + e2 * e2)
        rho = weights[m] * near * near * agreement * agreement
        score += rho
        n0, n1, n2 = n0 + qn[s, 0], n1 + qn[s, 1], n2 + qn[s, 2]
        length = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        _accumulate(
            normal_matrix, gradient, row, rho, n0 / length, n1 / length, n2 / length, x0, x1, x2, e0, e1, e2
        )
        _accumulate_point(normal_matrix, gradient, 0.1 * rho, x0, x1, x2, e0, e1, e2)
    return score


@njit(cache=True, nogil=True)
def _accumulate(  # type: ignore[no-untyped-def]
    normal_matrix, gradient, row, weight, n0, n1, n2, x0, x1, x2, e0, e1, e2
):
    row[0] = x1 * n2 - x2 * n1
    row[1] = x2 * n0 - x0 * n2
    row[2] = x0 * n1 - x1 * n0
    row[3], row[4], row[5] = n0, n1, n2
    residual = n0 * e0 + n1 * e1 + n2 * e2
    for a in range(6):
        gradient[a] -= weight * row[a] * residual
        for b in range(a + 1):
            normal_matrix[a, b] += weight * row[a] * row[b]


@njit(cache=True, nogil=True)
def _accumulate_point(normal_matrix, gradient, weight, x0, x1, x2, e0, e1, e2):  # type: ignore[no-untyped-def]
    """Add the point-to-point term: rows (x cross e_i, e_i) for the three axes, summed in closed form."""
    xx, yy, zz = x0 * x0, x1 * x1, x2 * x2
    normal_matrix[0, 0] += weight * (yy + zz)
    normal_matrix[1, 1] += weight * (xx + zz)
    normal_matrix[2, 2] += weight * (xx + yy)
    normal_matrix[1, 0] -= weight * x0 * x1
    normal_matrix[2, 0] -= weight * x0 * x2
    normal_matrix[2, 1] -= weight * x1 * x2
    normal_matrix[3, 1] += weight * x2
    normal_matrix[3, 2] -= weight * x1
    normal_matrix[4, 0] -= weight * x2
    normal_matrix[4, 2] += weight * x0
    normal_matrix[5, 0] += weight * x1
    normal_matrix[5, 1] -= weight * x0
    for axis in range(3):
        normal_matrix[3 + axis, 3 + axis] += weight
    gradient[0] -= weight * (x1 * e2 - x2 * e1)
    gradient[1] -= weight * (x2 * e0 - x0 * e2)
    gradient[2] -= weight * (x0 * e1 - x1 * e0)
    gradient[3] -= weight * e0
    gradient[4] -= weight * e1
    gradient[5] -= weight * e2


@njit(cache=True, nogil=True)
def _solve6(normal_matrix, gradient, step):  # type: ignore[no-untyped-def]
    """Solve the 6 x 6 system (lower triangle given) by Cholesky; False when it is singular."""
    for a in range(6):
        for b in range(a + 1):
            value = normal_matrix[a, b]
            for c in range(b):
                value -= normal_matrix[a, c] * normal_matrix[b, c]
            if a == b:
                if value <= 1e-9:
                    return False
                normal_matrix[a, a] = np.sqrt(value)
            else:
                normal_matrix[a, b] = value / normal_matrix[b, b]
    for a in range(6):
        value = gradient[a]
        for b in range(a):
            value -= normal_matrix[a, b] * step[b]
        step[a] = value / normal_matrix[a, a]
    for a in range(5, -1, -1):
        value = step[a]
        for b in range(a + 1, 6):
            value -= normal_matrix[b, a] * step[b]
        step[a] = value / normal_matrix[a, a]
    return True


@njit(cache=True, nogil=True)
def _move(rotation, translation, step):  # type: ignore[no-untyped-def]
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    for axis in range(3):
        translation[axis] += step[3 + axis]
    if angle < 1e-12:
        return
    # Far linearisations are only trusted up to half a radian.
    limited = min(angle, 0.5)
    a, b, c = step[0] / angle, step[1] / angle, step[2] / angle
    sin, cos = np.sin(limited), np.cos(limited)
    for column in range(3):
        v0, v1, v2 = rotation[0, column], rotation[1, column], rotation[2, column]
        along = (a * v0 + b * v1 + c * v2) * (1 - cos)
        rotation[0, column] = v0 * cos + (b * v2 - c * v1) * sin + a * along
        rotation[1, column] = v1 * cos + (c * v0 - a * v2) * sin + b * along
        rotation[2, column] = v2 * cos + (a * v1 - b * v0) * sin + c * along
