"""Coarse search: thousands of small robust ICPs all over the scan, thinned in two rounds to a few poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import super_fibonacci_rotations
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.scan_preparation import NearestGrid, PreparedScan
from scan2albedo.registration.template import Template

_CONE_RAD = np.deg2rad(35.0)
"""Greatest angle between the model's +z axis and the averaged outward normal at an anchor."""
_BLOCK = 128
_DISTINCT_POSES = 160
_SAME_ROTATION_RAD = np.deg2rad(8)
_SAME_POSITION_MM = 10.0


@dataclass(frozen=True)
class Poses:
    """`scan_from_model` poses: `rotations` (N, 3, 3) and `translations` (N, 3) in mm."""

    rotations: FloatArray
    translations: FloatArray

    def __len__(self) -> int:
        return len(self.rotations)

    def subset(self, index: IntArray) -> Poses:
        """Return the poses at `index`."""
        return Poses(self.rotations[index], self.translations[index])


def coarse_poses(
    scan: PreparedScan, template: Template, options: RegistrationOptions, meter: Meter, seed: int
) -> Poses:
    """Return distinct poses that place the model near the scan's surface, the nearest first.

    Round 1 runs `coarse_iterations` (4) on 60 model samples from every start; the best `kept_starts` go on to
    as many (8) on 200 samples with a tighter scale. The meter counts one evaluation a start and round; when
    its budget ends, the poses tried so far are ranked.
    """
    poses = anchored_starts(scan.anchors, template.front, options.rotation_count)
    # In random order a budget that ends early has still seen starts from all over the scan.
    poses = poses.subset(np.random.default_rng(seed).permutation(len(poses)))
    first, second = options.coarse_iterations
    poses = _round(scan.grid, template.first(60), poses, first, (20.0, 10.0), meter)
    poses = poses.subset(np.arange(min(options.kept_starts, len(poses))))
    poses = _round(scan.grid, template.first(200), poses, second, (12.0, 5.0), meter)
    return _distinct(poses, _DISTINCT_POSES)


def anchored_starts(anchors: OrientedPoints, front: FloatArray, rotation_count: int) -> Poses:
    """Put the model's `front` (3,) on the scan's anchors, in every rotation facing outward there.

    A face may be anywhere on a scan with shoulders and hair, so centroids are of little use; but the averaged
    normal at its front is roughly its +z axis. `rotation_count` super-Fibonacci rotations are tried at
    each anchor.
    """
    rotations = super_fibonacci_rotations(rotation_count)
    facing = anchors.normals @ rotations[:, :, 2].T >= np.cos(_CONE_RAD)
    anchor, rotation = np.nonzero(facing)
    turned = rotations[rotation]
    translations = anchors.points[anchor] - turned @ front
    return Poses(np.ascontiguousarray(turned), np.ascontiguousarray(translations))


def _round(
    grid: NearestGrid,
    model: OrientedPoints,
    starts: Poses,
    iterations: int,
    sigma_mm: tuple[float, float],
    meter: Meter,
) -> Poses:
    """Refine the starts block by block while the budget lasts; return those tried, best first."""
    rotations, translations = starts.rotations.copy(), starts.translations.copy()
    scores: list[FloatArray] = []
    for begin in range(0, len(starts), _BLOCK):
        if begin and meter.exhausted:
            break
        block = slice(begin, begin + _BLOCK)
        scores.append(
            refine_on_grid(
                grid,
                model,
                model.areas,
                rotations[block],
                translations[block],
                iterations=iterations,
                sigma_mm=sigma_mm,
            )
        )
        meter.count(len(scores[-1]))
    order = np.argsort(-np.concatenate(scores), kind="stable")
    return Poses(rotations[order], translations[order])


def _distinct(poses: Poses, count: int) -> Poses:
    """Keep the first of every group of like poses, at most `count`."""
    same_trace = 1 + 2 * np.cos(_SAME_ROTATION_RAD)
    kept: list[int] = []
    alike = np.zeros(len(poses), bool)
    for i in range(len(poses)):
        if alike[i]:
            continue
        kept.append(i)
        if len(kept) == count:
            break
        offset = poses.translations[i + 1 :] - poses.translations[i]
        trace = np.einsum("nij,ij->n", poses.rotations[i + 1 :], poses.rotations[i])
        near = np.einsum("ni,ni->n", offset, offset) < _SAME_POSITION_MM**2
        alike[i + 1 :] |= near & (trace > same_trace)
    return poses.subset(np.array(kept, np.int64))


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
