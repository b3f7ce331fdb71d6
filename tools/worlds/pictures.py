"""What the cameras of a photographic scanner see: pixels of K square pictures, row by row, one by one."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.synthetic.raw_scan import RangeMesh, Scanner, capture, pod
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.sitter import HEAD_AXIS_FROM_NOSE_MM

CAMERAS_DEG: dict[int, list[tuple[float, float]]] = {
    2: [(35, 5), (-35, 5)],
    3: [(0, 0), (55, 5), (-55, 5)],
    4: [(28, 12), (-28, -8), (75, 5), (-75, 5)],
    5: [(0, -12), (38, 10), (-38, 10), (80, 0), (-80, 0)],
}
"""Azimuth and elevation of the cameras by their number."""
CENTER_FROM_NOSE_MM = np.array([0.0, -10.0, -60.0])
"""What the cameras look at, from the tip of the nose."""
BEFORE_MM = 0.3
"""Rays that measure light start this far before the surface."""


def pods_around(center: FloatArray, count: int) -> FloatArray:
    """Return `count` cameras (count, 3, 4), a metre away, that see 180 mm on each side of `center`."""
    return np.stack(
        [pod(center, angles, reach_mm=180.0, distance_mm=1000.0) for angles in CAMERAS_DEG[count]]
    )


def measured_by(
    pods: FloatArray,
    vertices: FloatArray,
    faces: IntArray,
    tip: FloatArray,
    scanner: Scanner,
    rng: np.random.Generator,
) -> RangeMesh:
    """Return the mesh that a scanner's pods measure of a head whose nose ends at `tip` (3,)."""
    axis = tip + HEAD_AXIS_FROM_NOSE_MM
    return capture(vertices, faces, pods, spacing_mm=scanner.spacing_mm, rng=rng, axis_mm=axis)


@dataclass(frozen=True)
class Pictured:
    """Of K pictures of S x S pixels: `face` (K S S,) that each shows, -1 for none.

    `barycentric` and `position` (K S S, 3) there, and the `direction` of its ray.
    """

    face: IntArray
    barycentric: FloatArray
    position: FloatArray
    direction: FloatArray

    @property
    def hit(self) -> BoolArray:
        """(K S S,) True where a pixel shows the surface."""
        return self.face >= 0

    def before(self, pixels: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return starts and directions (N, 3) of rays that measure the light in some pixels."""
        return (self.position - BEFORE_MM * self.direction)[pixels], self.direction[pixels]


def pictured(vertices: FloatArray, faces: IntArray, pods: FloatArray, size: int) -> Pictured:
    """Return what the cameras see through the centres of their pixels."""
    direction = np.concatenate([pixel_directions(camera, texel_coordinates(size)) for camera in pods])
    origin = np.repeat(camera_centers(pods), size * size, axis=0)
    hits = RayCaster(vertices, faces).first_hit(origin, direction)
    hit, position = hits.face >= 0, np.zeros(direction.shape)
    position[hit] = np.einsum("nk,nkc->nc", hits.barycentric[hit], vertices[faces[hits.face[hit]]])
    return Pictured(hits.face, hits.barycentric, position, direction)


def used_pixels(measured: RangeMesh, pods: FloatArray, size: int) -> BoolArray:
    """Return (K S S,) which pixels colour the scan, two more around them."""
    marks = []
    for k, camera in enumerate(pods):
        u, v = project(camera, measured.vertices)[0].T
        pixel = size * np.stack([u, 1 - v], 1) - 0.5
        picture = np.zeros((size, size), np.uint8)
        for triangle in np.round(pixel[measured.faces[measured.face_pod == k]] * 16).astype(np.int32):
            cv2.fillConvexPoly(picture, triangle, 1, shift=4)
        marks.append(cv2.dilate(picture, np.ones((5, 5), np.uint8)).astype(bool).ravel())
    return np.concatenate(marks)


def filled(light: FloatArray, known: BoolArray, count: int, size: int) -> FloatArray:
    """Return light (K, S, S, 3); pixels that were not traced get that of the nearest one in their picture."""
    full = light.reshape(count, size, size, 3).copy()
    for picture, mark in zip(full, known.reshape(count, size, size), strict=True):
        if mark.any():
            row, column = distance_transform_edt(~mark, return_distances=False, return_indices=True)
            picture[:] = picture[row, column]
    return full


def row_of(pixels: FloatArray, count: int, size: int) -> FloatArray:
    """Return K pictures of pixels (K S S, 3) side by side (S, K S, 3)."""
    return np.concatenate(list(pixels.reshape(count, size, size, 3)), axis=1)


def bilinear(picture: NDArray[np.floating], place: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return (N, C) of a picture (H, W, C) at rows and columns `place` (2, N), the first pixel's middle 0."""
    channels = np.moveaxis(picture, 2, 0)
    return np.stack([map_coordinates(c, place, order=1, mode="nearest") for c in channels], 1)


def along(points: FloatArray, t: NDArray[np.floating] | float) -> FloatArray:
    """Return (T, K) the places at t (T,) on a polyline (N, K), whose corners lie at 0, 1, ..."""
    return np.stack([np.interp(t, np.arange(len(points)), axis) for axis in points.T], -1)


def filled_outline(outline: FloatArray, count: int, scales: FloatArray) -> FloatArray:
    """Return points (S count, 2) in a closed outline (N, 2): it, shrunk by each scale toward its middle."""
    closed, middle = np.concatenate([outline, outline[:1]]), outline.mean(0)
    rim = along(closed, np.linspace(0, len(outline), count))
    return np.concatenate([middle + scale * (rim - middle) for scale in scales])
