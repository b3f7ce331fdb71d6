"""Rigid and similarity transforms as 4x4 matrices `target_from_source` acting on column vectors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scan2albedo.core.arrays import ArrayLike, FloatArray, IntArray, all_finite
from scan2albedo.core.compiled import compiled
from scan2albedo.geometry.mesh import face_areas

Matrix = FloatArray


def transform_points(target_from_source: ArrayLike, points: ArrayLike) -> Matrix:
    """Return the (N, 3) points mapped by a (4, 4) affine transform."""
    matrix, xyz = np.asarray(target_from_source, float), np.asarray(points, float)
    return xyz @ matrix[:3, :3].T + matrix[:3, 3]


def transform_directions(target_from_source: ArrayLike, directions: ArrayLike) -> Matrix:
    """Return the (N, 3) directions turned by the linear part of a (4, 4) rigid transform."""
    return np.asarray(directions, float) @ np.asarray(target_from_source, float)[:3, :3].T


def compose(rotation: ArrayLike, translation: ArrayLike) -> Matrix:
    """Return the (4, 4) transform x -> R x + t from R (3, 3) and t (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def invert_rigid(target_from_source: ArrayLike) -> Matrix:
    """Return the inverse of a (4, 4) rigid transform."""
    matrix = np.asarray(target_from_source, float)
    rotation = matrix[:3, :3].T
    return compose(rotation, -rotation @ matrix[:3, 3])


def is_rigid(matrix: Matrix, tolerance: float = 1e-6) -> bool:
    """Return whether (4, 4) is a rotation, to a `tolerance`, and a translation over the row 0 0 0 1."""
    if not (all_finite(matrix) and np.array_equal(matrix[3], [0, 0, 0, 1])):
        return False
    turn = matrix[:3, :3]
    return bool(np.abs(turn @ turn.T - np.eye(3)).max() <= tolerance and np.linalg.det(turn) > 0)


@dataclass(frozen=True)
class Similarity:
    """x -> scale R x + t: `rotation` (3, 3), `translation` (3,), and a `scale` kept apart from them."""

    rotation: Matrix
    translation: Matrix
    scale: float = 1.0

    def apply(self, points: Matrix) -> Matrix:
        """Return the (N, 3) points moved."""
        return self.scale * points @ self.rotation.T + self.translation

    def matrix(self) -> Matrix:
        """Return (4, 4)."""
        return compose(self.scale * self.rotation, self.translation)

    def inverse(self) -> Matrix:
        """Return (4, 4), the inverse of `matrix`."""
        turned_back = self.rotation.T / self.scale
        return compose(turned_back, -turned_back @ self.translation)

    @classmethod
    def of_rigid(cls, transform: Matrix, scale: float, kept: Matrix) -> Similarity:
        """Return the similarity of which `rigid(kept)` is the transform (4, 4)."""
        rotation, translation = transform[:3, :3], transform[:3, 3]
        return cls(rotation, translation - (scale - 1) * rotation @ kept, scale)

    def rigid(self, kept: Matrix = np.zeros(3)) -> Matrix:
        """Return (4, 4) without the scale; the point `kept` (3,) maps to the same point."""
        return compose(self.rotation, self.translation + (self.scale - 1) * self.rotation @ kept)

    def is_near(self, other: Similarity, angle_rad: float, distance: float) -> bool:
        """Whether rotation and translation differ from the other's by less than this."""
        return (
            float(np.linalg.norm(self.translation - other.translation)) < distance
            and rotation_angle_rad(self.rotation @ other.rotation.T) < angle_rad
        )


def rotation_from_vector(rotation_vector_rad: ArrayLike) -> Matrix:
    """Return the (3, 3) rotation by a vector: axis times angle in radians."""
    return np.asarray(Rotation.from_rotvec(rotation_vector_rad).as_matrix(), float)


def rotation_angle_rad(rotation: ArrayLike) -> float:
    """Return the angle in radians of a (3, 3) rotation, accurate near 0 and pi."""
    return float(Rotation.from_matrix(rotation).magnitude())


def super_fibonacci_rotations(count: int) -> Matrix:
    """Return `count` well-spread rotations (count, 3, 3) over SO(3) [1]_.

    .. [1] M. Alexa, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
    """
    phi = np.sqrt(2.0)
    psi = 1.533751168755204288118041
    s = np.arange(count) + 0.5
    radius, radius_rest = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    xy = [radius * np.sin(alpha), radius * np.cos(alpha)]
    zw = [radius_rest * np.sin(beta), radius_rest * np.cos(beta)]
    return np.asarray(Rotation.from_quat(np.stack(xy + zw, -1)).as_matrix(), float)


def random_rotation(rng: np.random.Generator) -> Matrix:
    """Return a rotation (3, 3) drawn uniformly from SO(3)."""
    return np.asarray(Rotation.from_quat(np.roll(rng.normal(size=4), -1)).as_matrix(), float)


def procrustes(
    source: ArrayLike, target: ArrayLike, *, weights: ArrayLike | None = None, scale: bool = False
) -> Matrix:
    """Return the least-squares transform `target_from_source` (4, 4) between points (N, 3) [1]_.

    Minimises sum_i w_i |s R x_i + t - y_i|^2 over rotations R, translations t and, when `scale`, s > 0.
    Raises ValueError for shapes that do not agree, points that are not finite or coincide, and no weight.

    .. [1] S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
       IEEE PAMI 13(4), 1991.
    """
    x, y = np.asarray(source, float), np.asarray(target, float)
    if x.shape != y.shape or x.ndim != 2 or x.shape[1] != 3:
        raise ValueError(f"source {x.shape} and target {y.shape} must both be (N, 3)")
    w = np.ones(len(x)) if weights is None else np.asarray(weights, float)
    total = float(w.sum())
    if not (all_finite(x) and all_finite(y) and 0 < total < np.inf):
        said = f"{len(x)} pairs of points and weights of sum {total:g} place nothing"
        raise ValueError(f"{said}: points must be finite, and at least one must weigh something")
    w = w / total
    x_mean, y_mean = w @ x, w @ y
    u, singular, vt = np.linalg.svd((w[:, None] * (y - y_mean)).T @ (x - x_mean))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = (u * sign) @ vt
    factor = 1.0
    if scale:
        spread = float(w @ np.sum((x - x_mean) ** 2, 1))
        if not spread > 0:
            raise ValueError("source points that coincide have no size to compare; leave `scale` out")
        factor = float(singular @ sign / spread)
    return compose(factor * rotation, y_mean - factor * rotation @ x_mean)


def in_principal_frame(vertices: Matrix, faces: IntArray) -> tuple[Matrix, Matrix]:
    """Return the vertices (V, 3) in the surface's principal axes, and the rigid (4, 4) transform there.

    Origin at the surface's centroid, axes along the eigenvectors of its second moments (longest first) and
    toward the heavier tail of the third moments [1]_; so the same mesh in another pose arrives there.

    .. [1] M. Elad, A. Tal, S. Ar, "Content based retrieval of VRML objects", 2001 (pose normalisation).
    """
    # Differences to a vertex of the scan lose no digits however far away the origin is.
    anchor = vertices[faces[0, 0]]
    area, middle = face_areas(vertices, faces), (vertices[faces] - anchor).mean(1)
    total = area.sum()
    if total <= 0:
        return vertices - anchor, compose(np.eye(3), -anchor)
    center = area @ middle / total
    _, vectors = np.linalg.eigh((area[:, None] * middle).T @ middle / total - np.outer(center, center))
    axes = np.ascontiguousarray(vectors[:, ::-1])
    axes = axes * np.where(area @ ((middle - center) @ axes) ** 3 < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    origin = anchor + center
    return (vertices - origin) @ axes, compose(axes.T, -axes.T @ origin)


@compiled
def dot(a, b):  # type: ignore[no-untyped-def]
    """Return the inner product of two vectors of three numbers, inside other compiled functions."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def minus(a, b):  # type: ignore[no-untyped-def]
    """Return the difference of two vectors of three numbers, inside other compiled functions."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def cross(a, b):  # type: ignore[no-untyped-def]
    """Return the cross product of two vectors of three numbers, inside other compiled functions."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
