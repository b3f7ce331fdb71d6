"""How much a posed scan looks like a face: its depth image, and the relief that scan and model share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.registration.scan_noise import SurfaceNoise
from scan2albedo.registration.scan_preparation import NearestGrid

Mask = BoolArray

_NEAR_SAMPLE_MM = 15.0
_LEAST_NORMAL_Z = 0.3
_FEWEST_SAMPLES = 60
_SIZE = 72
_LOOK_THROUGH_MM = 30.0
_SAME_SURFACE_MM = 20.0
_SAME_POINT_MM = 10.0
"""A vertex as near to the depth image as that is on the surface it shows, steep and noisy as it may be."""
_STEEPEST_SLOPE = 1.5
_SMOOTHING_PIXELS = 1.5
_WINDOW_PIXELS = 4.0
_FEATURE_PIXELS = 5.0
_FLAT_SLOPE_SQUARED = 0.01
_FEWEST_PIXELS = 64
_ALLOWED_RMS_MM = 7.0
_NOISE_LEFT = 4.0
"""Noise of blurred slopes, relative to that of independent depths of the vertices: those between vertices are
interpolated, so that a blur lessens it less. Chosen so that people agree as much with noise
as without, as the two numbers below with the first 140 scans of tools/bench_door.py in sight: judge them by
its others (--offset)."""
_LEAST_VARIANCE = 0.1
"""Of slopes that noise is compared with: a third of a face's, so that a flat scrap is not excused."""
_LEAST_SIGNAL = 0.5
"""Noise excuses no more than this: most of what it hides is not known to be there."""
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


@dataclass(frozen=True)
class FaceScores:
    """Agreement of the depth images of the posed scan and the model.

    `coverage` is the part of the model's features with scan within 20 mm, `rms_mm` the RMS distance of the
    model's inlying samples to the scan. `relief_correlation` is the correlation of the depth derivatives in
    windows of about 3 cm, averaged over the features, after a quadratic fit is taken out of each: the bulge
    that a head shares with a ball does not count, and nose, orbits and mouth must each be there.
    """

    coverage: float
    relief_correlation: float
    rms_mm: float

    @property
    def likeness(self) -> float:
        """Relief correlation times exp(-(rms / 7 mm)^2); 0.9 for the model itself."""
        return self.relief_correlation * float(np.exp(-((self.rms_mm / _ALLOWED_RMS_MM) ** 2)))

    @property
    def ranking(self) -> float:
        """Likeness, lessened where little of the face is covered: ranks poses."""
        return self.likeness * min(1.0, self.coverage / 0.6) ** 0.5


@dataclass(frozen=True)
class ReliefAgreement:
    """How the depth image of a scan agrees with that of the template in the same shape.

    `local` is the correlation of the depth derivatives, less their quadratic trend, averaged over windows of
    about 3 cm, `whole` that over all windows together. `noise_mm` is that of the scan's vertices there, and
    `signal` the part of the variance of its slopes that it does not explain, 0.5 at least.
    """

    local: float
    whole: float
    noise_mm: float = 0.0
    signal: float = 1.0

    def without_noise(self) -> tuple[float, float]:
        """Return `local` and `whole` as they would be without noise: divided by the root of `signal` [1]_.

        .. [1] C. Spearman, "The proof and measurement of association between two things", 1904: correction
           for attenuation.
        """
        root = float(np.sqrt(self.signal))
        return min(self.local / root, 1.0), min(self.whole / root, 1.0)


class FaceImage:
    """The model's depth image, to score posed scans by: of its vertices (V, 3) mm and faces (F, 3)."""

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        self.vertices, self._faces = vertices, faces
        low, high = vertices.min(0), vertices.max(0)
        center = (low + high) / 2
        self.frame = DepthFrame((float(center[0]), float(center[1])), 1.02 * float(np.max(high - low)), _SIZE)
        self.depth = depth_image(vertices, faces, self.frame)
        self._inside = np.isfinite(self.depth)
        self._highest_mm = float(high[2]) + _LOOK_THROUGH_MM
        relief, _ = self._relief(self.depth, self._inside, 0.0)
        self._weights = self._inside * np.sqrt(gaussian_filter((relief**2).sum(0), _FEATURE_PIXELS))

    def scores(
        self,
        vertices: FloatArray,
        faces: IntArray,
        model_from_scan: FloatArray,
        rms_mm: float = 0.0,
    ) -> FaceScores:
        """Score a scan under a (4, 4) transform into the model's frame (rigid or similarity)."""
        seen = depth_image(vertices, faces, self.frame, model_from_scan, z_limit=self._highest_mm)
        difference = np.where(self._inside, seen, np.inf) - np.where(self._inside, self.depth, 0.0)
        common = np.abs(difference) < _SAME_SURFACE_MM
        coverage = float(self._weights[common].sum() / self._weights.sum())
        if common.sum() < _FEWEST_PIXELS:
            return FaceScores(coverage, 0.0, rms_mm)
        scan, used = self._relief(seen, common, _SMOOTHING_PIXELS)
        model, _ = self._relief(self.depth, common, _SMOOTHING_PIXELS)
        correlation = _local_correlation(scan, model, used, self._weights)
        return FaceScores(coverage, correlation, rms_mm)

    def agreement(
        self,
        vertices: FloatArray,
        faces: IntArray,
        noise: SurfaceNoise,
        model_from_scan: FloatArray,
        surface: FloatArray,
    ) -> ReliefAgreement:
        """Compare a scan under a (4, 4) transform with the model's mesh moved to `surface` (V, 3)."""
        seen = depth_image(vertices, faces, self.frame, model_from_scan, z_limit=self._highest_mm)
        depth = depth_image(surface, self._faces, self.frame)
        inside = self._inside & np.isfinite(depth)
        depth = np.where(inside, depth, 0.0)
        distance = np.abs(np.where(inside, seen, np.inf) - depth)
        common = distance < _SAME_SURFACE_MM
        if common.sum() < _FEWEST_PIXELS:
            return ReliefAgreement(0.0, 0.0)
        scan, used = self._relief(seen, common, _SMOOTHING_PIXELS)
        model, _ = self._relief(depth, common, _SMOOTHING_PIXELS)
        weights = self._weights * used
        both, of_scan, of_model = (
            float((weights * (a * b).sum(0)).sum()) + 1e-12
            for a, b in ((scan, model), (scan, scan), (model, model))
        )
        local = _local_correlation(scan, model, used, self._weights)
        on_face = self._shown(vertices, model_from_scan, np.where(common, seen, np.inf))
        noise_mm, area_mm2 = noise.among(on_face)
        scale = float(np.linalg.norm(model_from_scan[0, :3]))
        of_noise = self._slope_noise(noise_mm * scale, area_mm2 * scale**2)
        variance = max(of_scan / float(weights.sum()), _LEAST_VARIANCE)
        signal = max(1 - of_noise / variance, _LEAST_SIGNAL)
        return ReliefAgreement(local, both / float(np.sqrt(of_scan * of_model)), noise_mm, signal)

    def _slope_noise(self, noise_mm: float, area_mm2: float) -> float:
        """Return the variance of blurred slopes (both axes) that noise of vertices, one in an area, makes.

        Of independent depths under a Gaussian blur s it would be noise^2 area / (4 pi s^4).
        """
        blur_mm = _SMOOTHING_PIXELS * self.frame.pixel
        return float(_NOISE_LEFT * noise_mm**2 * area_mm2 / (4 * np.pi * blur_mm**4))

    def _shown(self, vertices: FloatArray, model_from_scan: FloatArray, seen: FloatArray) -> Mask:
        """Return which vertices (V,) lie on the surface that a depth image (S, S) shows."""
        points = vertices @ model_from_scan[:3, :3].T + model_from_scan[:3, 3]
        middle = (_SIZE - 1) / 2
        column = np.rint((points[:, 0] - self.frame.center[0]) / self.frame.pixel + middle)
        row = np.rint(middle - (points[:, 1] - self.frame.center[1]) / self.frame.pixel)
        shown = (column >= 0) & (column < _SIZE) & (row >= 0) & (row < _SIZE)
        at = seen[row[shown].astype(int), column[shown].astype(int)]
        shown[shown] = np.abs(points[shown, 2] - at) < _SAME_POINT_MM
        return shown

    def _relief(self, depth: FloatArray, mask: Mask, smoothing: float) -> tuple[FloatArray, Mask]:
        """Return (2, S, S) slopes without their quadratic trend, 0 outside, and where they exist (S, S)."""
        smooth = _smoothed(depth, mask, smoothing)
        used = np.zeros_like(mask)
        used[:-1, :-1] = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1]
        position = np.argwhere(used) / _SIZE - 0.5
        relief = np.zeros((2, *mask.shape))
        for image, axis in zip(relief, (1, 0), strict=True):
            slope = np.diff(smooth, axis=axis, append=0.0)[used] / self.frame.pixel
            slope = np.clip(slope, -_STEEPEST_SLOPE, _STEEPEST_SLOPE)
            image[used] = without_quadratic_trend(slope, position, np.ones(len(slope)))
        return relief, used


def _smoothed(depth: FloatArray, mask: Mask, sigma: float) -> FloatArray:
    """Return the depth blurred within the mask, 0 outside."""
    filled = np.where(mask, depth, 0.0)
    if sigma == 0:
        return filled
    weight = gaussian_filter(mask.astype(np.float64), sigma)
    return np.where(mask, gaussian_filter(filled, sigma) / np.maximum(weight, 1e-9), 0.0)


def _local_correlation(a: FloatArray, b: FloatArray, used: Mask, weights: FloatArray) -> float:
    """Return the weighted mean over pixels of the correlation of a and b (2, S, S) in Gaussian windows."""

    def window(values: NDArray[Any]) -> FloatArray:
        return gaussian_filter(values.astype(np.float64), _WINDOW_PIXELS)

    # Flat windows correlate by chance; a slope of 0.1 must be there before they count.
    floor = _FLAT_SLOPE_SQUARED * (window(used) + 1e-9)
    norm = np.sqrt((window((a * a).sum(0)) + floor) * (window((b * b).sum(0)) + floor))
    counted = weights * used
    return float((counted * window((a * b).sum(0)) / norm).sum() / max(counted.sum(), 1e-300))


def normal_relief(
    grid: NearestGrid, model: OrientedPoints, rotation: FloatArray, translation: FloatArray
) -> float:
    """Return the correlation of model and scan slopes without their quadratic trend, -1 ... 1.

    Slopes come from the normals of the model samples, placed by rotation (3, 3) and translation (3,)
    `scan_from_model`, and of the scan samples nearest to them; the result is lessened by the square root of
    the part of the model that has a near scan sample.
    """
    placed = model.points @ rotation.T + translation
    index = grid.nearest_samples(placed)
    normals = grid.samples.normals[index] @ rotation
    offset = grid.samples.points[index] - placed
    near = np.einsum("ij,ij->i", offset, offset) < _NEAR_SAMPLE_MM**2
    front = model.normals[:, 2] > _LEAST_NORMAL_Z
    used = front & near & (index >= 0) & (normals[:, 2] > 0)
    if used.sum() < _FEWEST_SAMPLES:
        return 0.0
    position = model.points[used, :2] / np.abs(model.points[:, :2]).max()
    weights = model.areas[used]
    slopes = np.concatenate([_slopes(model.normals[used]), _slopes(normals[used])], 1)
    relief = without_quadratic_trend(slopes, position, weights)
    alike = correlation(relief[:, :2].ravel(), relief[:, 2:].ravel(), np.repeat(weights, 2))
    return alike * float(np.sqrt(used.sum() / front.sum()))


def _slopes(normals: FloatArray) -> FloatArray:
    return normals[:, :2] / np.maximum(normals[:, 2:], _LEAST_NORMAL_Z)


def without_quadratic_trend(values: FloatArray, position: FloatArray, weights: FloatArray) -> FloatArray:
    """Return values (N,) or (N, K) minus their weighted quadratic fit in position (N, 2) of order 1."""
    x, y = position.T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    weighted = basis * weights[:, None]
    ridge = 1e-9 * (weights.sum() + 1e-300) * np.eye(6)
    return values - basis @ np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ values)


def correlation(a: FloatArray, b: FloatArray, weights: FloatArray) -> float:
    """Return sum w a b / sqrt(sum w a^2 sum w b^2), 0 when either vanishes.

    >>> correlation(np.array([1.0, -1.0]), np.array([3.0, -3.0]), np.ones(2))
    1.0
    """
    norm = float(np.sqrt((weights @ (a * a)) * (weights @ (b * b))))
    return float(weights @ (a * b)) / norm if norm > 0 else 0.0
