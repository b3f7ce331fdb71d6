"""Align a surface with another: robust Gauss-Newton over pose, size and modes of shape."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.ndimage import distance_transform_edt

from scan2albedo.core.arrays import FloatArray, NDArray, dots
from scan2albedo.core.compiled import compiled, triple
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import Similarity, cross, dot, rotation_from_vector
from scan2albedo.optimization.least_squares import SMALLEST_DIAGONAL, NormalEquations, damped_step


@dataclass(frozen=True)
class Pairs:
    """Where the N points of a source shall go, as seen from where they are.

    `offset` (N, 3) leads to the target; its part along the unit `normal` (N, 3) counts with the `trust` (N,),
    the part `along` (N,) of this in every direction. `noise` is the residuals' standard deviation.
    """

    offset: FloatArray
    normal: FloatArray
    trust: FloatArray
    along: FloatArray | float = 0.0
    noise: float = 0.0


@dataclass(frozen=True)
class Alignment:
    """x -> s R (x + B c) + t: `pose` (s, R, t), and `coefficients` c (K,) of the modes B.

    The last of the `steps` `moved` the pose by so many degrees or units, whichever is more.
    """

    pose: Similarity
    coefficients: FloatArray
    steps: int = 0
    moved: float = np.inf
    converged: bool = False


def align(
    points: FloatArray,
    weights: FloatArray,
    pairs: Callable[[Alignment, FloatArray], Pairs | None],
    start: Alignment | Similarity = Similarity(np.eye(3), np.zeros(3)),
    *,
    steps: int,
    modes: FloatArray | None = None,
    precision: FloatArray | None = None,
    scale_range: tuple[float, float] = (0.0, np.inf),
    settled: float = 0.0,
) -> Alignment:
    """Return where reweighted Gauss-Newton steps take points (N, 3) with modes (N, 3, K) of their shape.

    Each step lowers, over rotation, translation, log s and c,

        sum_i w_i r_i [(1 - a_i) (n_i . e_i)^2 + a_i |e_i|^2] + noise^2 W (log s, c) P (log s, c)^T / 300,
        e_i = s R (x_i + B_i c) + t - y_i,

    with the targets y_i, normals n_i and weights r_i that `pairs` finds anew at the present alignment; None
    ends the search, as does a step shorter than `settled`. `weights` w (N,) have the sum W, `precision` P (K
    + 1, K + 1) is 0 by default; `scale_range` bounds s. One step costs O(N (K + 7)^2).
    """
    count = 0 if modes is None else modes.shape[2]
    known = np.zeros((count + 1, count + 1)) if precision is None else precision
    now = Alignment(start, np.zeros(count)) if isinstance(start, Similarity) else replace(start, steps=0)
    for step in range(steps):
        pose, c = now.pose, now.coefficients
        moved = pose.apply(points if modes is None else points + modes @ c)
        found = pairs(now, moved)
        if found is None:
            break
        weight = weights * found.trust
        spread = weight * found.along
        index, normal, weight, by = np.arange(len(points)), found.normal, weight - spread, modes
        if len(light := np.flatnonzero(spread)):
            # A distance in every direction is that along three axes.
            index = np.concatenate([index, np.repeat(light, 3)])
            normal = np.concatenate([normal, np.tile(np.eye(3), (len(light), 1))])
            weight = np.concatenate([weight, np.repeat(spread[light], 3)])
            by = None if modes is None else modes[index]
        turned = (moved - pose.translation)[index]
        rows = np.empty((len(index), 7 + count))
        rows[:, :3], rows[:, 3:6] = np.cross(turned, normal), normal
        rows[:, 6] = dots(turned, normal)
        if by is not None:
            rows[:, 7:] = ((pose.scale * normal @ pose.rotation)[:, None, :] @ by)[:, 0]
        weighted = weight[:, None] * rows
        matrix = weighted.T @ rows
        gradient = -(weighted.T @ dots(found.offset[index], normal))
        size = np.log(pose.scale)
        # Neighbouring pairs err together: all of them count as 300 against the prior.
        prior = found.noise**2 * weights.sum() / 300 * known
        matrix[6:, 6:] += prior
        gradient[6:] += prior @ np.concatenate([[size], c])
        upper, lower = np.full(7 + count, np.inf), np.full(7 + count, -np.inf)
        low, high = np.log(np.maximum(scale_range, 1e-300)) - size
        lower[6], upper[6] = min(low, 0.0), max(high, 0.0)
        # The damping is that of rounding: what nothing determines stays.
        change = damped_step(NormalEquations(matrix, gradient, lower, upper), SMALLEST_DIAGONAL)
        rotation = rotation_from_vector(change[:3]) @ pose.rotation
        pose = Similarity(rotation, pose.translation + change[3:6], pose.scale * float(np.exp(change[6])))
        length = max(float(np.rad2deg(np.linalg.norm(change[:3]))), float(np.linalg.norm(change[3:6])))
        now = Alignment(pose, c + change[7:], step + 1, length, length < settled)
        if now.converged:
            break
    return now


@dataclass(frozen=True)
class NearestGrid:
    """A voxel grid over a point cloud.

    `nearest` (X, Y, Z) holds the (nearly) nearest sample to each cell's centre, `origin` (3,) is the corner
    of cell (0, 0, 0), `cell` the side of a cell.
    """

    samples: OrientedPoints
    nearest: NDArray[np.int32]
    origin: FloatArray
    cell: float

    @classmethod
    def of(cls, samples: OrientedPoints, *, cell: float, margin: float) -> Self:
        """Build the grid over the samples' box widened by `margin`; huge boxes get larger cells."""
        low, high = samples.points.min(0) - margin, samples.points.max(0) + margin
        cell = max(cell, float(np.cbrt(np.prod(high - low) / 1_500_000)))
        place = (samples.points - low) / cell
        inside = place.astype(int)
        # Of the samples in a cell the one nearest to its centre; in the others that of the nearest such cell.
        order = np.argsort(-np.sum((place - inside - 0.5) ** 2, axis=1), kind="stable")
        nearest = np.full(np.ceil((high - low) / cell).astype(int) + 1, -1, np.int32)
        nearest[tuple(inside[order].T)] = order
        cells = distance_transform_edt(nearest < 0, return_distances=False, return_indices=True)
        return cls(samples, nearest[tuple(cells)], low, cell)


def align_on_grid(
    grid: NearestGrid,
    model: OrientedPoints,
    rotations: FloatArray,
    translations: FloatArray,
    *,
    steps: int,
    sigma: tuple[float, float],
) -> FloatArray:
    """Align the (M,) model samples with a grid from thousands of rigid poses, which change in place.

    Takes the steps of `align`, compiled, with a tenth of the weight in every direction, n_i the mean of both
    normals [1]_ and Geman-McClure weights of scales geometric between the two of `sigma`. `rotations` (N, 3,
    3) and `translations` (N, 3) are overwritten. Returns (N,) scores: the last weights' mean, 0 ... 1.

    .. [1] S. Rusinkiewicz, "A symmetric objective function for ICP", SIGGRAPH 2019 (mean normals).
    """
    scores = np.zeros(len(rotations))
    _align_all(
        (grid.nearest, grid.origin, grid.cell, grid.samples.points, grid.samples.normals),
        (model.points, model.normals, model.areas / model.areas.sum()),
        rotations,
        translations,
        np.append(np.geomspace(*sigma, steps), sigma[1]),
        scores,
    )
    return scores


@compiled
def _align_all(grid, model, rotations, translations, sigmas, scores):  # type: ignore[no-untyped-def]
    matrix, gradient = np.zeros((6, 6)), np.zeros(6)
    for start in range(len(rotations)):
        rotation, translation = rotations[start], translations[start]
        for i, sigma in enumerate(sigmas):
            scores[start] = _linearize(grid, model, rotation, translation, sigma, matrix, gradient)
            if scores[start] == 0.0:
                break
            if i + 1 == len(sigmas):
                continue
            for k in range(6):
                matrix[k, k] += 1e-9
            step = np.linalg.solve(matrix, gradient)
            angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            translation += step[3:]
            if angle < 1e-12:
                continue
            limited = min(angle, 0.5)  # radians: linearisations about a far pose are trusted no further
            axis = step[0] / angle, step[1] / angle, step[2] / angle
            sin = np.sin(limited)
            cos = np.cos(limited)
            # Rodrigues' formula, column by column.
            for column in range(3):
                v = rotation[0, column], rotation[1, column], rotation[2, column]
                across = cross(axis, v)
                along = dot(axis, v) * (1 - cos)
                rotation[0, column] = v[0] * cos + across[0] * sin + axis[0] * along
                rotation[1, column] = v[1] * cos + across[1] * sin + axis[1] * along
                rotation[2, column] = v[2] * cos + across[2] * sin + axis[2] * along


@compiled
def _linearize(grid, model, rotation, translation, sigma, matrix, gradient):  # type: ignore[no-untyped-def]
    """Fill in the normal equations (6, 6), (6,) of one pose, and return its score."""
    nearest, origin, cell, q, qn = grid
    p, pn, weights = model
    matrix[:] = 0.0
    gradient[:] = 0.0
    score = 0.0
    row = np.zeros(6)
    first, second, third = triple(rotation, 0), triple(rotation, 1), triple(rotation, 2)
    nx, ny, nz = nearest.shape
    for m in range(len(p)):
        point, normal = triple(p, m), triple(pn, m)
        # The rotated point, about whose translation the small rotation is taken.
        x = dot(first, point), dot(second, point), dot(third, point)
        i = int(np.floor((x[0] + translation[0] - origin[0]) / cell))
        j = int(np.floor((x[1] + translation[1] - origin[1]) / cell))
        k = int(np.floor((x[2] + translation[2] - origin[2]) / cell))
        if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
            continue
        s = nearest[i, j, k]
        other = triple(qn, s)
        turned = dot(first, normal), dot(second, normal), dot(third, normal)
        agreement = dot(turned, other)
        if agreement <= 0.0:
            continue
        e = (
            x[0] + translation[0] - q[s, 0],
            x[1] + translation[1] - q[s, 1],
            x[2] + translation[2] - q[s, 2],
        )
        near = sigma * sigma / (sigma * sigma + e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
        rho = weights[m] * near * near * agreement * agreement
        score += rho
        both = turned[0] + other[0], turned[1] + other[1], turned[2] + other[2]
        length = np.sqrt(dot(both, both))
        n = both[0] / length, both[1] / length, both[2] / length
        row[0], row[1], row[2] = cross(x, n)
        row[3], row[4], row[5] = n
        _add_plane(matrix, gradient, row, rho, dot(n, e))
        _add_axes(matrix, gradient, x, e, 0.1 * rho)
    for a in range(6):
        for b in range(a):
            matrix[b, a] = matrix[a, b]
    return score


@compiled
def _add_plane(matrix, gradient, row, weight, residual):  # type: ignore[no-untyped-def]
    """Add the distance from a plane to the lower half of the normal equations."""
    for a in range(6):
        gradient[a] -= weight * row[a] * residual
        for b in range(a + 1):
            matrix[a, b] += weight * row[a] * row[b]


@compiled
def _add_axes(matrix, gradient, x, e, weight):  # type: ignore[no-untyped-def]
    """Add the planes of the three axes, rows (x cross e_i, e_i), summed in closed form."""
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        matrix[a, a] += weight * (x[b] * x[b] + x[c] * x[c])
        matrix[max(a, b), min(a, b)] -= weight * x[a] * x[b]
        matrix[3 + a, b] += weight * x[c]
        matrix[3 + a, c] -= weight * x[b]
        matrix[3 + a, 3 + a] += weight
        gradient[a] -= weight * (x[b] * e[c] - x[c] * e[b])
        gradient[3 + a] -= weight * e[a]
