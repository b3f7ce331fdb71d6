"""Orthographic depth images of a posed mesh, seen from +z: compiled, thousands a second."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray

_ON_EDGE = 1e-9


@dataclass(frozen=True)
class DepthFrame:
    """The square of side `width`, `size` pixels a side, that a depth image shows, in the mesh's unit.

    Pixel (row r, column c) looks at x = center_x + (c - (size - 1) / 2) pixel, y = center_y - (r - (size - 1)
    / 2) pixel: row 0 is the top.
    """

    center: tuple[float, float]
    width: float
    size: int

    @property
    def pixel(self) -> float:
        """Side of a pixel."""
        return self.width / self.size

    def coordinates(self) -> FloatArray:
        """Return (size, size, 2) x and y of the pixel centres.

        >>> DepthFrame((0.0, 0.0), 4.0, 2).coordinates()[0, 1]
        array([1., 1.])
        """
        offset = (np.arange(self.size) - (self.size - 1) / 2) * self.pixel
        x, y = np.meshgrid(self.center[0] + offset, self.center[1] - offset)
        return np.stack([x, y], -1)


def depth_image(
    vertices: ArrayLike,
    faces: ArrayLike,
    frame: DepthFrame,
    view_from_mesh: ArrayLike | None = None,
    *,
    z_limit: float = np.inf,
) -> FloatArray:
    """Return (size, size) greatest z at each pixel centre, -inf where the mesh is not seen.

    Both sides of `faces` (F, 3) are seen, after the rigid `view_from_mesh` (4, 4) of the vertices (V, 3).
    Surface above `z_limit` is ignored (a hand or a lock of hair before the face).
    """
    pose = np.eye(4) if view_from_mesh is None else np.asarray(view_from_mesh, np.float64)
    image = np.empty((frame.size, frame.size))
    vertices = np.ascontiguousarray(vertices, np.float64)
    render_depth(
        vertices,
        np.ascontiguousarray(faces, np.int64),
        np.ascontiguousarray(pose),
        (float(frame.center[0]), float(frame.center[1]), frame.pixel),
        float(z_limit),
        np.empty_like(vertices),
        image,
    )
    return image


@njit(cache=True, nogil=True)
def render_depth(vertices, faces, pose, view, z_limit, projected, image):  # type: ignore[no-untyped-def]
    """Fill `image` (S, S) with depths; `projected` (V, 3) is scratch, `view` is (x, y, pixel side)."""
    height, width = image.shape
    image[:] = -np.inf
    for v in range(vertices.shape[0]):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        projected[v, 0] = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3] - view[0]) / view[
            2
        ] + (width - 1) / 2
        projected[v, 1] = (height - 1) / 2 - (
            pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3] - view[1]
        ) / view[2]
        projected[v, 2] = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    for f in range(faces.shape[0]):
        _fill(projected, faces[f, 0], faces[f, 1], faces[f, 2], z_limit, image)


@njit(cache=True, nogil=True)
def _fill(projected, a, b, c, z_limit, image):  # type: ignore[no-untyped-def]
    ax, ay, az = projected[a, 0], projected[a, 1], projected[a, 2]
    bx, by, bz = projected[b, 0], projected[b, 1], projected[b, 2]
    cx, cy, cz = projected[c, 0], projected[c, 1], projected[c, 2]
    height, width = image.shape
    first_row, last_row = max(np.ceil(min(ay, by, cy)), 0.0), min(np.floor(max(ay, by, cy)), height - 1.0)
    first_column, last_column = (
        max(np.ceil(min(ax, bx, cx)), 0.0),
        min(np.floor(max(ax, bx, cx)), width - 1.0),
    )
    if first_row > last_row or first_column > last_column:
        return
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area == 0.0:
        return
    # z = az + slope_x (column - ax) + slope_y (row - ay) on the plane of the face.
    slope_x = ((bz - az) * (cy - ay) - (cz - az) * (by - ay)) / area
    slope_y = ((cz - az) * (bx - ax) - (bz - az) * (cx - ax)) / area
    # The edges bound the columns of every row; testing pixel by pixel costs mispredicted branches.
    side = 1.0 if area > 0 else -1.0
    low_a, low_step_a, high_a, high_step_a = _bounds(ax, ay, bx, by, side)
    low_b, low_step_b, high_b, high_step_b = _bounds(bx, by, cx, cy, side)
    low_c, low_step_c, high_c, high_step_c = _bounds(cx, cy, ax, ay, side)
    for row in range(int(first_row), int(last_row) + 1):
        low = max(low_a + low_step_a * row, low_b + low_step_b * row, low_c + low_step_c * row, first_column)
        high = min(
            high_a + high_step_a * row, high_b + high_step_b * row, high_c + high_step_c * row, last_column
        )
        from_z = az - slope_x * ax + slope_y * (row - ay)
        for column in range(int(np.ceil(low)), int(np.floor(high)) + 1):
            z = from_z + slope_x * column
            if z > image[row, column] and z <= z_limit:
                image[row, column] = z


@njit(cache=True, nogil=True)
def _bounds(px, py, qx, qy, side):  # type: ignore[no-untyped-def]
    """Return least and greatest column as functions of the row (value, step, value, step) beside an edge."""
    rise = qy - py
    if abs(rise) < 1e-12:
        return -np.inf, 0.0, np.inf, 0.0
    step = (qx - px) / rise
    at_zero = px - step * py
    if side * rise < 0:
        return at_zero - _ON_EDGE, step, np.inf, 0.0
    return -np.inf, 0.0, at_zero + _ON_EDGE, step
