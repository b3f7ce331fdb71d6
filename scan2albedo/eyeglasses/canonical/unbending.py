"""A frame without its bends, in its own shape and size: rims move rigidly, temples keep their lengths."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.canonical.mean_keypoints import align_key_points, is_posable
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR
from scan2albedo.eyeglasses.skinning import turned_translations
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_normals, normalized
from scan2albedo.geometry.rigid import (
    compose,
    invert_rigid,
    procrustes,
    rotation_angle_rad,
    rotation_from_vector,
    transform_points,
)

_MIRROR = np.array(MIRROR)
_SIDES = ("left", "right")
_BRIDGE = np.array([0, 1])
_RIMS, _TEMPLES = (
    tuple(
        np.array(
            [k for k, n in enumerate(KEY_POINT_NAMES) if n.startswith(side) and n.split("_")[1] in words]
        )
        for side in _SIDES
    )
    for words in (("rim",), ("hinge", "temple", "ear"))
)
"""Numbers of each side's key points; of a temple from the hinge to the tip."""
_OWN, _NEAR = 0.9, 0.5
"""Shares of a rim's key points in a vertex's weights from which it moves with the rim, and is near it."""
_SAMPLES, _FEWEST = 1000, 50
"""Vertices of a rim that are laid on the other one, at most and at least."""
_ROUNDS, _SETTLED = 30, 1e-6
"""Rounds of laying one rim on the other; the last one's step, as a part of the rim's size."""
_LABEL_SHARE = 1e-3
"""Weight of a rim's key points beside its surface: they hold what a surface leaves free, such as a turn of a
round rim in its plane."""
_FARTHEST_TURN, _FARTHEST_SHIFT = np.deg2rad(10), 0.15
"""How far surfaces may move a rim from where its key points lay it: more is another place that fits by
chance; the shift as a part of the rim's size."""


@dataclass(frozen=True)
class FrontHalves:
    """How the two halves of a front lie to each other.

    `reflection` (4, 4) mirrors the frame in a plane, about that of its symmetry; `left_from_mirrored`
    (4, 4), rigid, then lays the mirrored right rim on the left one, which takes in how the plane is tilted.
    `apart` is the root mean square distance of the surfaces, NaN where only key points were compared.
    """

    reflection: FloatArray
    left_from_mirrored: FloatArray
    apart: float

    @property
    def sides(self) -> tuple[FloatArray, FloatArray]:
        """(4, 4) rigid transforms of the left and the right half after which they mirror each other."""
        # The rigid H with H H = left_from_mirrored, which turns by less than half a turn.
        turn = _nearest_rotation(np.eye(3) + self.left_from_mirrored[:3, :3])
        half = compose(turn, np.linalg.solve(np.eye(3) + turn, self.left_from_mirrored[:3, 3]))
        return invert_rigid(half), self.reflection @ half @ np.linalg.inv(self.reflection)

    @property
    def bend_deg(self) -> float:
        """By how much one half is turned against the other."""
        left, right = self.sides
        return float(np.rad2deg(rotation_angle_rad(left[:3, :3] @ right[:3, :3].T)))


def front_halves(
    vertices: FloatArray, faces: IntArray, weights: FloatArray, points: FloatArray
) -> FrontHalves | None:
    """Return how the halves of a frame's front lie; None where too few key points (20, 3) mirror each other.

    Key points lay the mirror image of the right rim on the left rim; then the surfaces do, by iterated
    closest points, since people place key points to a millimetre at best.
    """
    reflection = _reflection(points)
    if reflection is None:
        return None
    both = np.isfinite(points + points[_MIRROR]).all(1)
    rim = _RIMS[0][both[_RIMS[0]]]
    source, target = transform_points(reflection, points[_MIRROR[rim]]), points[rim]
    if not is_posable(target):
        return FrontHalves(reflection, np.eye(4), np.nan)
    start = procrustes(source, target)
    own, other = (weights[:, rim_points].sum(1) for rim_points in _RIMS)
    surface = faces[(own[faces] >= _NEAR).all(1)]
    moving = transform_points(reflection, vertices[other >= _OWN])
    if len(surface) < _FEWEST or len(moving) < _FEWEST:
        return FrontHalves(reflection, start, np.nan)
    moving = moving[:: -(-len(moving) // _SAMPLES)]
    found, apart = _lay_on(vertices, surface, moving, (source, target), start)
    return FrontHalves(reflection, found, apart)


def _lay_on(
    vertices: FloatArray,
    faces: IntArray,
    moving: FloatArray,
    marks: tuple[FloatArray, FloatArray],
    start: FloatArray,
) -> tuple[FloatArray, float]:
    """Return the rigid (4, 4) that lays points (P, 3) on a surface, and their rms distance from it then."""
    query, normals, size = (
        ClosestPointQuery(vertices, faces),
        face_normals(vertices, faces),
        float(np.linalg.norm(np.ptp(marks[1], axis=0))),
    )
    pose = start
    for _ in range(_ROUNDS):
        placed = transform_points(pose, moving)
        hits = query.query(placed)
        # Tukey's weights: what one rim has and the other lacks does not pull.
        reach = 3 * float(np.median(hits.distance)) + 1e-9 * size
        weight = np.clip(1 - (hits.distance / reach) ** 2, 0, None) ** 2
        normal, center = normals[hits.face], placed.mean(0)
        rows = np.hstack([np.cross(placed - center, normal), normal]) * np.sqrt(weight)[:, None]
        off = ((placed - hits.points) * normal).sum(1) * np.sqrt(weight)
        held = transform_points(pose, marks[0])
        pull = np.sqrt(_LABEL_SHARE * weight.sum() / len(held))
        turns = np.cross(held[:, None] - center, np.eye(3)).reshape(-1, 3)
        rows = np.vstack([rows, pull * np.hstack([turns, np.tile(np.eye(3), (len(held), 1))])])
        off = np.concatenate([off, pull * (held - marks[1]).ravel()])
        step = np.linalg.lstsq(rows, -off, rcond=None)[0]
        turn = rotation_from_vector(step[:3])
        pose = compose(turn, center + step[3:] - turn @ center) @ pose
        if np.linalg.norm(step[:3]) + np.linalg.norm(step[3:]) / size < _SETTLED:
            break
    distance = query.query(transform_points(pose, moving)).distance
    change = pose @ invert_rigid(start)
    moved = np.linalg.norm(transform_points(pose, marks[0]) - transform_points(start, marks[0]), axis=1)
    far = np.trace(change[:3, :3]) < 1 + 2 * np.cos(_FARTHEST_TURN) or moved.max() > _FARTHEST_SHIFT * size
    return (start, np.nan) if far else (pose, float(np.sqrt((distance**2).mean())))


def unbent_transforms(points: FloatArray, halves: FrontHalves | None) -> FloatArray:
    """Return (20, 4, 4) rigid transforms of key points (20, 3), NaN for missing ones, that take the bend
    away.

    With F the reflection and Q = `left_from_mirrored`, the key points of the left rim and its hinge share
    Q^-1/2, those of the right side F Q^1/2 F: both move half the way and mirror each other afterwards. The
    bridge follows both by half. Bones of the temples keep their lengths, and their directions become the
    mean of both sides. What both sides are bent to alike is no difference between them, and stays.
    """
    if halves is None:
        return np.tile(np.eye(4), (len(points), 1, 1))
    sides, targets = halves.sides, points.copy()
    for side, rim, temple in zip(sides, _RIMS, _TEMPLES, strict=True):
        for part in (rim, temple):
            targets[part] = transform_points(side, points[part])
    targets[_BRIDGE] = np.mean([transform_points(side, points[_BRIDGE]) for side in sides], axis=0)
    # Temples run in the mean direction of both sides; one whose counterpart is not known stays.
    reflect, bent = halves.reflection[:3, :3], targets.copy()
    for temple in _TEMPLES:
        for a, b in itertools.pairwise(temple[np.isfinite(bent[temple]).all(1)]):
            bone, other = bent[b] - bent[a], reflect @ (bent[_MIRROR[b]] - bent[_MIRROR[a]])
            if np.isfinite(other).all():
                bone = np.linalg.norm(bone) * normalized(normalized(bone) + normalized(other))
            targets[b] = targets[a] + bone
    rigid = align_key_points(points, targets)
    result = turned_translations(transform_points(rigid, points), targets) @ rigid
    turn = _nearest_rotation(sides[0][:3, :3] + sides[1][:3, :3])
    for k in _BRIDGE:
        result[k] = compose(turn, targets[k] - turn @ points[k])
    for side, rim, temple in zip(sides, _RIMS, _TEMPLES, strict=True):
        result[rim] = result[temple[0]] = side
    # Key points that the frame lacks weigh nothing; NaN times nothing would still be NaN.
    result[~np.isfinite(points).all(1)] = rigid
    return result


def _nearest_rotation(matrix: FloatArray) -> FloatArray:
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray((u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt)


def symmetric_key_points(points: FloatArray, reflection: FloatArray | None = None) -> FloatArray:
    """Return the mean of key points (20, 3) and their mirror image, themselves where one is missing.

    The `reflection` (4, 4) is their own when omitted; where they fix none, they are returned.
    """
    reflection = _reflection(points) if reflection is None else reflection
    if reflection is None:
        return points
    image = transform_points(reflection, points[_MIRROR])
    return np.where(np.isfinite(image), (points + image) / 2, points)


def _reflection(points: FloatArray) -> FloatArray | None:
    """Return the (4, 4) that mirrors key points (20, 3); None where too few have a counterpart."""
    image = (points * [-1.0, 1.0, 1.0])[_MIRROR]
    both = np.isfinite(image).all(1) & np.isfinite(points).all(1)
    if not is_posable(points[both]):
        return None
    return procrustes(image[both], points[both]) @ np.diag([-1.0, 1, 1, 1])
