"""How much a posed scan looks like a face: its depth image, and the relief that scan and model share."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from scan2albedo.core.arrays import ArrayLike, BoolArray, FloatArray, IntArray, NDArray
from scan2albedo.geometry.oriented_points import SurfaceNoise
from scan2albedo.geometry.rasterization import nearest_depths
from scan2albedo.geometry.rigid import transform_points

_FEWEST_SAMPLES = 60
_SIZE = 72
LOOK_THROUGH_MM = 30.0
"""What lies farther before the model is not a face: a hand, a lock of hair."""
_SAME_SURFACE_MM = 20.0
_SMOOTHING_PIXELS = 1.5
"""Standard deviation of the blur of depth images before their slopes."""
_WINDOW_PIXELS = 4.0
"""Standard deviation of the windows in which slopes are correlated."""
_FLAT_SLOPE_SQUARED = 0.01
_NOISE_LEFT = 4.0
"""Noise of blurred slopes, relative to that of independent depths of the vertices: those between vertices are
interpolated, so that a blur lessens it less. Chosen so that people agree as much with noise as without,
as were the two numbers below, with the first 140 scans of tools/bench/door.py in sight."""
_LEAST_VARIANCE = 0.1
"""Of slopes that noise is compared with: a third of a face's, so that a flat scrap is not excused."""


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

    def pixels(self, points: FloatArray) -> FloatArray:
        """Return the places (N, 2), column and row, of points (N, 3)."""
        return (points[:, :2] - self.center) / [self.pixel, -self.pixel] + (self.size - 1) / 2


def depth_image(
    vertices: FloatArray,
    faces: ArrayLike,
    frame: DepthFrame,
    view_from_mesh: FloatArray | None = None,
    *,
    z_limit: float = np.inf,
) -> FloatArray:
    """Return (size, size) greatest z at each pixel centre, -inf where the mesh is not seen.

    Both sides of `faces` (F, 3) are seen, after `view_from_mesh` (4, 4); those above `z_limit` are ignored.
    """
    points = vertices if view_from_mesh is None else transform_points(view_from_mesh, vertices)
    pixels, depth = frame.pixels(points), points[:, 2]
    pixels[depth > z_limit] = np.nan  # no face of such a vertex is drawn
    return nearest_depths(pixels, depth, faces, (frame.size, frame.size))


@dataclass(frozen=True)
class ReliefAgreement:
    """How the depth image of a scan agrees with the model's.

    `coverage` is the part of the model's features with scan within 20 mm. `local` is the correlation of the
    depth derivatives, less their quadratic trend, averaged over windows of about 3 cm, `whole` that over all
    windows together. `noise_mm` is that of the scan's vertices, `signal` the rest of its slopes' variance.
    """

    coverage: float
    local: float
    whole: float
    noise_mm: float = 0.0
    signal: float = 1.0

    def without_noise(self) -> float:
        """Return `whole` as it would be without noise: divided by the root of `signal` [1]_, at most 1.

        .. [1] C. Spearman, "The proof and measurement of association between two things", 1904: correction
           for attenuation.
        """
        return min(self.whole / float(np.sqrt(self.signal)), 1.0)


class FaceImage:
    """The model's depth image, to score posed scans by: of its vertices (V, 3) mm and faces (F, 3)."""

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        self.faces = faces
        low, high = vertices.min(0), vertices.max(0)
        center = (low + high) / 2
        self.frame = DepthFrame((float(center[0]), float(center[1])), 1.02 * float(np.max(high - low)), _SIZE)
        self._depth = depth_image(vertices, faces, self.frame)
        inside = np.isfinite(self._depth)
        self._highest_mm = float(high[2]) + LOOK_THROUGH_MM
        relief, _ = self._relief(self._depth, inside, 0.0)
        self._weights = inside * np.sqrt(gaussian_filter((relief**2).sum(0), _WINDOW_PIXELS))

    def agreement(
        self,
        vertices: FloatArray,
        faces: IntArray,
        model_from_scan: FloatArray,
        surface: FloatArray | None = None,
        noise: SurfaceNoise | None = None,
    ) -> ReliefAgreement:
        """Compare a scan under a (4, 4) similarity into the model's frame with the model.

        `surface` (V, 3) are the vertices of the model in another shape. The scan's `noise` is measured where
        it lies at the model, when given.
        """
        seen = depth_image(vertices, faces, self.frame, model_from_scan, z_limit=self._highest_mm)
        depth = self._depth if surface is None else depth_image(surface, self.faces, self.frame)
        inside = (self._weights > 0) & np.isfinite(depth)
        depth = np.where(inside, depth, 0.0)
        common = np.abs(np.where(inside, seen, np.inf) - depth) < _SAME_SURFACE_MM
        coverage = float(self._weights[common].sum() / self._weights.sum())
        if common.sum() < _FEWEST_SAMPLES:
            return ReliefAgreement(coverage, 0.0, 0.0)
        scan, used = self._relief(seen, common, _SMOOTHING_PIXELS)
        model, _ = self._relief(depth, common, _SMOOTHING_PIXELS)
        weights = self._weights * used
        both, of_scan, of_model = (
            float((weights * (a * b).sum(0)).sum()) + 1e-12
            for a, b in ((scan, model), (scan, scan), (model, model))
        )
        whole = both / float(np.sqrt(of_scan * of_model))

        def window(values: NDArray) -> FloatArray:
            return gaussian_filter(values.astype(float), _WINDOW_PIXELS)

        # Flat windows correlate by chance; a slope of 0.1 must be there before they count.
        floor = _FLAT_SLOPE_SQUARED * (window(weights > 0) + 1e-9)
        norm = np.sqrt((window((scan * scan).sum(0)) + floor) * (window((model * model).sum(0)) + floor))
        local = float((weights * window((scan * model).sum(0)) / norm).sum() / max(weights.sum(), 1e-300))
        if noise is None:
            return ReliefAgreement(coverage, local, whole)
        # Noise of the vertices that lie on the surface which the image shows: within 10 mm, however steep.
        points = transform_points(model_from_scan, vertices)
        # Far vertices have pixels that no integer holds.
        column, row = np.rint(self.frame.pixels(points)).T
        shown = (column >= 0) & (column < _SIZE) & (row >= 0) & (row < _SIZE)
        at = np.where(common, seen, np.inf)[row[shown].astype(int), column[shown].astype(int)]
        shown[shown] = np.abs(points[shown, 2] - at) < 10
        noise_mm, area_mm2 = noise.among(shown)
        # Variance of blurred slopes (both axes). Of independent depths, one in an area, under a Gaussian
        # blur s it would be noise^2 area / (4 pi s^4).
        blur_mm = _SMOOTHING_PIXELS * self.frame.pixel / float(np.linalg.norm(model_from_scan[0, :3]))
        of_noise = _NOISE_LEFT * noise_mm**2 * area_mm2 / (4 * np.pi * blur_mm**4)
        variance = max(of_scan / float(weights.sum()), _LEAST_VARIANCE)
        # Noise excuses no more than half: most of what it hides is not known to be there.
        return ReliefAgreement(coverage, local, whole, noise_mm, max(1 - of_noise / variance, 0.5))

    def _relief(self, depth: FloatArray, mask: BoolArray, smoothing: float) -> tuple[FloatArray, BoolArray]:
        """Return (2, S, S) slopes without their quadratic trend, 0 outside, and where they exist (S, S)."""
        smooth = np.where(mask, depth, 0.0)
        if smoothing > 0:
            weight = np.maximum(gaussian_filter(mask.astype(float), smoothing), 1e-9)
            smooth = np.where(mask, gaussian_filter(smooth, smoothing) / weight, 0.0)
        used = np.zeros_like(mask)
        used[:-1, :-1] = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1]
        position = np.argwhere(used) / _SIZE - 0.5
        relief = np.zeros((2, *mask.shape))
        for image, axis in zip(relief, (1, 0), strict=True):
            slope = np.diff(smooth, axis=axis, append=0.0)[used] / self.frame.pixel
            slope = np.clip(slope, -1.5, 1.5)
            image[used] = without_quadratic_trend(slope, position, np.ones(len(slope)))
        return relief, used


def without_quadratic_trend(values: FloatArray, position: FloatArray, weights: FloatArray) -> FloatArray:
    """Return values (N,) or (N, K) minus their weighted quadratic fit in position (N, 2) of order 1."""
    x, y = position.T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    weighted = basis * weights[:, None]
    ridge = 1e-9 * (weights.sum() + 1e-300) * np.eye(6)
    return values - basis @ np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ values)
