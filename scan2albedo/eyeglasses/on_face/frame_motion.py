"""How a frame moves and bends: a rigid motion, shifts of its key points, their derivatives and prior."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scan2albedo.core.arrays import FloatArray, finite_rows, identities, norms
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.mean_keypoints import FRONT
from scan2albedo.eyeglasses.skinning import known_bones, moved_by, turn_conditions, turned_translations
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import blocks
from scan2albedo.geometry.rigid import compose, rotation_from_vector

RIGID = 6
"""First parameters of a step: a turn about the key points' centroid (rad), a translation."""
_STRETCH = 0.001
"""Part of its length by which a bone is usually stretched."""
_SCALE = 0.01
"""Part by which the whole frame is usually too large or too small, as a mesh that somebody measured."""
_RIM_TURN_RAD = 0.005
"""How much neighbouring key points of a rim are usually turned against each other."""
_BRIDGE_TURN_RAD = 0.02
"""The same of the bridge's key points."""
_TEMPLE_TURN_RAD = 0.03
"""The same of a temple's key points."""
_RIGID_MM = 1e-3
"""Deviation of the rigid part of the shifts, which the frame's own motion stands for."""
_BRIDGE = np.array(["bridge" in n for n in KEY_POINT_NAMES])


@dataclass(frozen=True)
class SkinnedPoints:
    """Points at `rest` (N, 3) that follow a frame's key points with `weights` (N, K), whose rows sum to 1."""

    rest: FloatArray
    weights: FloatArray

    def __getitem__(self, chosen: Any) -> SkinnedPoints:
        return SkinnedPoints(self.rest[chosen], self.weights[chosen])


@dataclass(frozen=True)
class FrameState:
    """Where a frame is and how it is bent: by `shifts` (K, 3) of the key points, in the frame's axes.

    `rotation` (3, 3) is `world_from_frame`, `origin` (3,) where the centroid of the key points at rest goes.
    """

    rotation: FloatArray
    origin: FloatArray
    shifts: FloatArray

    def moved(self, step: FloatArray) -> FrameState:
        """Return the state after a step (6,) or (6 + 3 K,): turn, translation, shifts."""
        shifts = self.shifts if len(step) == RIGID else self.shifts + step[RIGID:].reshape(-1, 3)
        return FrameState(rotation_from_vector(step[:3]) @ self.rotation, self.origin + step[3:RIGID], shifts)


class FrameMotion:
    """A state of one frame with what its points and derivatives need.

    A point x with weights w goes to

        y = R (sum over k of w_k (R_k (x - p_k) + p_k + s_k) - m) + o,

    R_k the skeleton's turn at key point k (`turned_translations`), m the centroid of the key points p (K, 3)
    at rest, NaN where the frame lacks one.
    """

    def __init__(self, keypoints: FloatArray, state: FrameState) -> None:
        self.keypoints, self.state = keypoints, state
        self.known = finite_rows(keypoints)
        self.center = keypoints[self.known].mean(0)

    @cached_property
    def handles(self) -> FloatArray:
        """(K, 4, 4) from the frame at rest to the bent frame; the identity for key points that it lacks."""
        result = turned_translations(self.keypoints, self.keypoints + self.state.shifts)
        result[~self.known] = np.eye(4)
        return result

    @cached_property
    def marks(self) -> SkinnedPoints:
        """The key points themselves; those that the frame lacks at 0."""
        return SkinnedPoints(np.nan_to_num(self.keypoints), np.eye(len(self.keypoints)))

    @property
    def world_from_frame(self) -> FloatArray:
        """(4, 4) rigid."""
        rotation = self.state.rotation
        return compose(rotation, self.state.origin - rotation @ self.center)

    @cached_property
    def transforms(self) -> FloatArray:
        """(K, 4, 4) from the frame at rest to the world, for `skin`."""
        return self.world_from_frame @ self.handles

    def positions(self, points: SkinnedPoints) -> FloatArray:
        """Return (N, 3) in the world."""
        return moved_by(self.transforms, points.weights, points.rest)

    def rows(
        self, points: SkinnedPoints, positions: FloatArray, slopes: FloatArray, *, rigid: bool = False
    ) -> FloatArray:
        """Return derivatives (N, 6 + 3 K) by a step of values whose slopes at points are (N, 3).

        Handles turn as the key points shift. Of a `rigid` frame (N, 6), by turn and translation.
        """
        moving = np.concatenate([np.cross(positions - self.state.origin, slopes), slopes], 1)
        if rigid:
            return moving
        filled = np.where(self.known[:, None], self.keypoints, self.center)
        arm = np.einsum("kij,nkj->nki", self.handles[:, :3, :3], points.rest[:, None] - filled)
        pull = points.weights[:, :, None] * (slopes @ self.state.rotation)[:, None]
        turning, shifting = (a.reshape(-1, len(self.turns)) for a in (np.cross(arm, pull), pull))
        return np.concatenate([moving, shifting + turning @ self.turns], 1)

    def covariances(self, points: SkinnedPoints, root: FloatArray) -> FloatArray:
        """Return covariances (N, 3, 3) of points in the world that follow from that of a step, root root^T.

        `root` is (6, P) for a frame that stays rigid, (6 + 3 K, P) for one that bends.
        """
        parts = [np.zeros((0, 3, 3))]
        for block in blocks(len(points.rest), 2**12):
            some, rigid = points[block], len(root) == RIGID
            place = self.positions(some)
            along = [self.rows(some, place, np.full_like(place, axis), rigid=rigid) for axis in np.eye(3)]
            spread = np.stack(along, 1) @ root
            parts.append(spread @ spread.transpose(0, 2, 1))
        return np.concatenate(parts)

    @cached_property
    def turns(self) -> FloatArray:
        """(3 K, 3 K): turns of the handles (rad, about the frame's axes) by shifts of the key points.

        They keep the `turn_conditions` symmetric: their right side is the sum over bones of (R_k a) x db.
        """
        count, bones = len(self.keypoints), known_bones(self.keypoints)
        rotations, bent = self.handles[:, :3, :3], self.keypoints + self.state.shifts
        k, j = bones.T
        before, along = normalized(self.keypoints[j] - self.keypoints[k]), bent[j] - bent[k]
        length = norms(along)[:, None]
        after = along / length
        carried = np.einsum("bij,bj->bi", rotations[k], before)
        across = (np.eye(3) - np.einsum("bi,bj->bij", after, after)) / length[:, :, None]
        lever = np.cross(carried[:, None, :], np.eye(3)).transpose(0, 2, 1) @ across
        drive = np.zeros((count, count, 3, 3))
        np.add.at(drive, (k, j), lever)
        np.add.at(drive, (k, k), -lever)
        _, system = turn_conditions(rotations, before, after, bones)
        flat = drive.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)
        return np.asarray(np.linalg.solve(system, flat), float)


def bend_prior(motion: FrameMotion) -> tuple[FloatArray, FloatArray]:
    """Return residuals (N,) in standard deviations and their derivatives (N, 6 + 3 K).

    Of each bone: its stretch and the turn of its ends against each other; then the shifts' rigid motions.
    """
    bones = known_bones(motion.keypoints)
    bones = bones[bones[:, 0] < bones[:, 1]]
    k, j = bones.T
    # Stretches, whitened for the part that all share: of their mean only so much is left.
    bent = motion.keypoints + motion.state.shifts
    length = norms(motion.keypoints[j] - motion.keypoints[k])
    along, sigma = bent[j] - bent[k], _STRETCH * length
    heading, number = normalized(along) / sigma[:, None], np.arange(len(bones))
    by_ends = np.zeros((len(bones), len(bent), 3))
    by_ends[number, j], by_ends[number, k] = heading, -heading
    stretch, stretch_rows = (norms(along) - length) / sigma, by_ends.reshape(len(bones), -1)
    shared = 1 - _STRETCH / np.hypot(_STRETCH, np.sqrt(len(bones)) * _SCALE)
    stretch, stretch_rows = stretch - shared * stretch.mean(), stretch_rows - shared * stretch_rows.mean(0)
    # Relative turns R_j R_k^T as axes times angles; derivatives to first order in them.
    turn_rad = np.where(_BRIDGE[bones].all(1), _BRIDGE_TURN_RAD, _RIM_TURN_RAD)
    turn_rad = np.where(~FRONT[bones].all(1), _TEMPLE_TURN_RAD, turn_rad)[:, None]
    rotations = motion.handles[:, :3, :3]
    turn = Rotation.from_matrix(np.einsum("bij,blj->bil", rotations[j], rotations[k])).as_rotvec() / turn_rad
    turns = motion.turns.reshape(len(rotations), 3, -1)
    turn_rows = ((turns[j] - turns[k]) / turn_rad[:, None]).reshape(3 * len(bones), -1)
    # Rigid motions of the shifts; key points that the frame lacks stay where they are.
    arm = np.where(motion.known[:, None], motion.keypoints - motion.center, 0.0)
    moves = identities(len(arm), 3)
    about = np.cross(arm[:, None], np.eye(3)) / norms(arm).mean()
    rigid_rows = np.concatenate([moves, about], 2) * motion.known[:, None, None]
    rigid_rows = rigid_rows.transpose(2, 0, 1).reshape(6, -1) / _RIGID_MM / motion.known.sum()
    rigid_rows = np.concatenate([rigid_rows, np.eye(rigid_rows.shape[1])[np.repeat(~motion.known, 3)]])
    rigid = rigid_rows @ motion.state.shifts.ravel()
    rows = np.concatenate([stretch_rows, turn_rows, rigid_rows])
    return np.concatenate([stretch, turn.ravel(), rigid]), np.pad(rows, ((0, 0), (RIGID, 0)))
