"""What is known of frames beside the pictures: how they bend, and that they rest on the nose."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.on_face.frame_motion import RIGID, FrameMotion, SkinnedPoints
from scan2albedo.eyeglasses.skinning import known_bones
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_normals, normalized

_STRETCH = 0.001
"""Part of its length by which a bone is usually stretched."""
_SCALE = 0.01
"""By how much the whole frame is usually too large or too small, as a mesh that somebody measured."""
_RIM_TURN_RAD, _BRIDGE_TURN_RAD, _TEMPLE_TURN_RAD = 0.005, 0.02, 0.03
"""How much neighbouring key points are usually turned against each other: of a rim, across the bridge, of
hinges and temples."""
_RIGID_MM = 1e-3
"""Deviation of the rigid part of the shifts, which the frame's own motion stands for."""
_BRIDGE = np.array(["bridge" in n for n in KEY_POINT_NAMES])
_TEMPLE = np.array(["hinge" in n or "temple" in n or "ear" in n for n in KEY_POINT_NAMES])

_CANDIDATES = 200
"""Front vertices nearest to the head that are looked at until they are chosen anew."""
_FRONT = np.array(["rim" in name or "bridge" in name for name in KEY_POINT_NAMES])


def bend_prior(motion: FrameMotion) -> tuple[FloatArray, FloatArray]:
    """Return residuals (N,) in standard deviations and their derivatives (N, 6 + 3 K).

    Of each bone: its stretch, beside one that all have in common, and the turn of its two ends against each
    other; then the six rigid motions within the shifts, which must be 0.
    """
    bones = known_bones(motion.keypoints)
    bones = bones[bones[:, 0] < bones[:, 1]]
    parts = [_stretch(motion, bones), _turn(motion, bones), _rigid(motion)]
    value, rows = (np.concatenate(block) for block in zip(*parts, strict=True))
    return value, np.pad(rows, ((0, 0), (RIGID, 0)))


def _stretch(motion: FrameMotion, bones: IntArray) -> tuple[FloatArray, FloatArray]:
    k, j = bones.T
    bent = motion.keypoints + motion.state.shifts
    length = np.linalg.norm(motion.keypoints[j] - motion.keypoints[k], axis=1)
    along = bent[j] - bent[k]
    sigma = _STRETCH * length
    rows = np.zeros((len(bones), len(bent), 3))
    heading = normalized(along) / sigma[:, None]
    number = np.arange(len(bones))
    rows[number, j], rows[number, k] = heading, -heading
    value, slopes = (np.linalg.norm(along, axis=1) - length) / sigma, rows.reshape(len(bones), -1)
    # Whitened for stretches that share a part: of their mean only so much is left.
    left = _STRETCH / np.hypot(_STRETCH, np.sqrt(len(bones)) * _SCALE)
    return value - (1 - left) * value.mean(), slopes - (1 - left) * slopes.mean(0)


def _turn(motion: FrameMotion, bones: IntArray) -> tuple[FloatArray, FloatArray]:
    """Relative turns R_j R_k^T; derivatives to first order in them."""
    k, j = bones.T
    sigma = np.select(
        [_TEMPLE[bones].any(1), _BRIDGE[bones].all(1)],
        [_TEMPLE_TURN_RAD, _BRIDGE_TURN_RAD],
        _RIM_TURN_RAD,
    )
    rotations = motion.handles[:, :3, :3]
    relative = np.einsum("bij,blj->bil", rotations[j], rotations[k])
    turns = motion.turns.reshape(len(rotations), 3, -1)
    value = _rotation_vectors(relative) / sigma[:, None]
    rows = (turns[j] - turns[k]) / sigma[:, None, None]
    return value.ravel(), rows.reshape(3 * len(bones), -1)


def _rotation_vectors(rotations: FloatArray) -> FloatArray:
    """Return (N, 3) axes times angles of rotations (N, 3, 3) well below half a turn."""
    skew = (rotations - rotations.transpose(0, 2, 1)) / 2
    axis = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, (np.trace(rotations, axis1=1, axis2=2) - 1) / 2)
    return axis * np.where(sine > 1e-12, angle / np.where(sine > 0, sine, 1), 1.0)[:, None]


def _rigid(motion: FrameMotion) -> tuple[FloatArray, FloatArray]:
    arm = np.where(motion.known[:, None], motion.keypoints - motion.center, 0.0)
    moves = np.tile(np.eye(3), (len(arm), 1, 1))
    spread = np.linalg.norm(arm, axis=1).mean()
    turns = np.cross(arm[:, None], np.eye(3)) / spread
    rows = np.concatenate([moves, turns], 2) * motion.known[:, None, None]
    rows = rows.transpose(2, 0, 1).reshape(6, -1) / _RIGID_MM / motion.known.sum()
    # Key points that the frame lacks stay where they are.
    still = np.eye(rows.shape[1])[np.repeat(~motion.known, 3)]
    rows = np.concatenate([rows, still])
    return rows @ motion.state.shifts.ravel(), rows


class HeadContact:
    """The least signed distance of a frame's front from a head in the world, (H, 3) and (G, 3)."""

    def __init__(self, points: SkinnedPoints, vertices: FloatArray, faces: IntArray) -> None:
        self._query = ClosestPointQuery(vertices, faces)
        self._normals = face_normals(vertices, faces)
        front = np.flatnonzero(_FRONT[points.weights.argmax(1)])
        self._front = SkinnedPoints(points.rest[front], points.weights[front])
        self._candidates = self._front

    def orient(self, motion: FrameMotion, viewers: FloatArray) -> None:
        """Turn the head's normals to the viewers (C, 3) if most of those near the frame's front look away."""
        place = motion.positions(self._front)
        hits = self._query.query(place)
        toward = viewers.mean(0) - hits.points
        if np.einsum("ni,ni->n", self._normals[hits.face], toward).sum() < 0:
            self._normals = -self._normals

    def select_candidates(self, motion: FrameMotion) -> None:
        """Choose the vertices that may touch next."""
        if len(self._front.rest) > _CANDIDATES:
            distance = self._query.query(motion.positions(self._front)).distance
            nearest = np.argpartition(distance, _CANDIDATES)[:_CANDIDATES]
            self._candidates = SkinnedPoints(self._front.rest[nearest], self._front.weights[nearest])

    def __bool__(self) -> bool:
        return len(self._front.rest) > 0

    def nearest_point(self, motion: FrameMotion) -> tuple[SkinnedPoints, FloatArray, float, FloatArray]:
        """Return the point that is nearest or deepest, its place (1, 3), signed distance, slope (1, 3)."""
        place = motion.positions(self._candidates)
        hits = self._query.query(place)
        normals = self._normals[hits.face]
        height = np.einsum("ni,ni->n", place - hits.points, normals)
        signed = np.where(height < 0, -hits.distance, hits.distance)
        first = int(np.argmin(signed))
        away = place[first] - hits.points[first]
        length = float(np.linalg.norm(away))
        slope = normals[first] if length < 1e-9 else np.sign(signed[first]) * away / length
        one = slice(first, first + 1)
        point = SkinnedPoints(self._candidates.rest[one], self._candidates.weights[one])
        return point, place[one], float(signed[first]), slope[None]
