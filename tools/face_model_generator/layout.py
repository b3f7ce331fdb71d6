"""A nearly isometric plane layout of the key points, and the smooth surface above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import Delaunay

from face_model_generator.key_points import HalfFace
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.parametrization import flatten_disc

CYLINDER_DEPTH_MM = -45.0
"""Depth of the vertical axis about which key points are unrolled before flattening."""


@dataclass(frozen=True)
class FaceLayout:
    """Key points in a plane (millimetres, nearly isometric, mirror symmetric about u = 0).

    Parameters
    ----------
    flat : (K, 2) float64
        Left half's key points in the plane.
    points : (K, 3) float64
        The same key points in space.
    """

    flat: FloatArray
    points: FloatArray

    def lift(self, flat: FloatArray) -> FloatArray:
        """Return (N, 3) points of the smooth surface above plane points (N, 2).

        Thin-plate spline through the key points and their mirror images, so the surface is symmetric.
        """
        inner = self.points[:, 0] > 1e-9
        sites = np.concatenate([self.flat, self.flat[inner] * [-1, 1]])
        values = np.concatenate([self.points, self.points[inner] * [-1, 1, 1]])
        spline = RBFInterpolator(sites, values, kernel="thin_plate_spline", smoothing=SMOOTHING)
        return spline(flat)

    def place(self, points: FloatArray) -> FloatArray:
        """Return the (N, 2) layout of key points given by their exact coordinates (N, 3)."""
        distance = np.linalg.norm(self.points[None] - points[:, None], axis=2)
        return self.flat[np.argmin(distance, axis=1)]


SMOOTHING = 8.0
"""Weight of bending against interpolation: takes the rounding of the key points' table out."""


def layout_of(half: HalfFace) -> FaceLayout:
    """Flatten the key points: unroll, triangulate, map with least distortion."""
    points = half.points
    middle = np.abs(points[:, 0]) < 1e-9
    unrolled, outline = _unrolled(points), _unrolled(half.curves["outline"])
    faces = Delaunay(unrolled).simplices
    polygon = np.concatenate([outline, _unrolled(half.curves["midline"])[::-1][1:-1]])
    faces = faces[inside_polygon(unrolled[faces].mean(1), polygon)]
    faces = _counter_clockwise(unrolled, faces)
    whole, mirrored, mirror = mirrored_mesh(points, faces, middle)
    flat = flatten_disc(whole, mirrored, mirror=mirror, boundary_weight=1e-3)
    flat *= np.sqrt(face_areas(whole, mirrored).sum())
    half_flat = np.round(flat[: len(points)], 4)
    half_flat[middle, 0] = 0.0
    return FaceLayout(half_flat, points)


def _unrolled(points: FloatArray) -> FloatArray:
    angle = np.arctan2(points[:, 0], points[:, 2] - CYLINDER_DEPTH_MM)
    return np.stack([angle * 70.0, points[:, 1]], 1)


def _counter_clockwise(flat: FloatArray, faces: IntArray) -> IntArray:
    a, b, c = flat[faces[:, 0]], flat[faces[:, 1]], flat[faces[:, 2]]
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    return np.where((turn < 0)[:, None], faces[:, [0, 2, 1]], faces).astype(np.int64)


def mirrored_mesh(
    points: FloatArray, faces: IntArray, middle: BoolArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return (points, faces, mirror index) of a half mesh joined to its mirror image at `middle`."""
    count = len(points)
    image = np.where(middle, np.arange(count), 0)
    image[~middle] = count + np.arange(int((~middle).sum()))
    signs = np.ones(points.shape[1])
    signs[0] = -1.0
    whole = np.concatenate([points, points[~middle] * signs])
    mirror = np.concatenate([image, np.flatnonzero(~middle)])
    return whole, np.concatenate([faces, image[faces][:, [0, 2, 1]]]), mirror


def inside_polygon(points: FloatArray, polygon: FloatArray) -> BoolArray:
    """Return (N,) whether plane points (N, 2) lie in a closed polygon (M, 2): even-odd rule."""
    ax, ay = polygon.T
    bx, by = np.roll(polygon, -1, axis=0).T
    x, y = points[:, :1], points[:, 1:]
    spans = (ay > y) != (by > y)
    rise = np.where(by == ay, 1.0, by - ay)
    crosses = x < ax + (y - ay) * (bx - ax) / rise
    return np.sum(spans & crosses, axis=1) % 2 == 1
