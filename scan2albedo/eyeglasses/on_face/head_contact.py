"""A frame rests on the nose: the anchor where pictures do not see depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, SkinnedPoints
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_normals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CANDIDATES = 200
"""Front vertices nearest to the head that are watched between two choices."""
_FRONT = np.array(["rim" in name or "bridge" in name for name in KEY_POINT_NAMES])


class HeadContact:
    """The least signed distance of a frame's front from a head.

    Parameters
    ----------
    points : SkinnedPoints
        The frame's vertices.
    vertices, faces : (H, 3), (G, 3)
        The head in the world.
    """

    def __init__(self, points: SkinnedPoints, vertices: FloatArray, faces: IntArray) -> None:
        self._query = ClosestPointQuery(vertices, faces)
        self._normals = face_normals(vertices, faces)
        front = np.flatnonzero(_FRONT[points.weights.argmax(1)])
        self._front = SkinnedPoints(points.rest[front], points.weights[front])
        self._watched = self._front

    def face(self, motion: FrameMotion, viewers: FloatArray) -> None:
        """Turn the head's normals to the viewers (C, 3) if most of those near the frame's front look away."""
        place = motion.positions(self._front)
        hits = self._query.query(place)
        toward = viewers.mean(0) - hits.points
        if np.einsum("ni,ni->n", self._normals[hits.face], toward).sum() < 0:
            self._normals = -self._normals

    def watch(self, motion: FrameMotion) -> None:
        """Choose the vertices that may touch next."""
        if len(self._front.rest) > _CANDIDATES:
            distance = self._query.query(motion.positions(self._front)).distance
            nearest = np.argpartition(distance, _CANDIDATES)[:_CANDIDATES]
            self._watched = SkinnedPoints(self._front.rest[nearest], self._front.weights[nearest])

    def __bool__(self) -> bool:
        return len(self._front.rest) > 0

    def touch(self, motion: FrameMotion) -> tuple[SkinnedPoints, FloatArray, float, FloatArray]:
        """Return the point that is nearest or deepest, its place (1, 3), signed distance, slope (1, 3)."""
        place = motion.positions(self._watched)
        hits = self._query.query(place)
        normals = self._normals[hits.face]
        height = np.einsum("ni,ni->n", place - hits.points, normals)
        signed = np.where(height < 0, -hits.distance, hits.distance)
        first = int(np.argmin(signed))
        away = place[first] - hits.points[first]
        length = float(np.linalg.norm(away))
        slope = normals[first] if length < 1e-9 else np.sign(signed[first]) * away / length
        point = SkinnedPoints(self._watched.rest[first : first + 1], self._watched.weights[first : first + 1])
        return point, place[first : first + 1], float(signed[first]), slope[None]
