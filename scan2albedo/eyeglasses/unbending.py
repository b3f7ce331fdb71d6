"""A frame without its bends, in its own shape and size: rims move rigidly, temples keep their lengths."""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scan2albedo.core.arrays import (
    SMALLEST,
    FloatArray,
    IntArray,
    all_finite,
    finite_rows,
    identities,
    norms,
    rms,
)
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR
from scan2albedo.eyeglasses.mean_keypoints import FRONT, RIMS, SIDES, align_key_points, is_posable
from scan2albedo.eyeglasses.skinning import turned_translations
from scan2albedo.geometry.alignment import Alignment, Pairs, align
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_normals, normalized
from scan2albedo.geometry.rigid import Similarity, compose, procrustes, rotation_angle_rad, transform_points
from scan2albedo.statistics.robust import tukey_weights

_TEMPLES = [np.flatnonzero(~FRONT & [n.startswith(side) for n in KEY_POINT_NAMES]) for side in SIDES]
"""Numbers of the left and the right temple's key points, from the hinge to the tip."""
_OWN = 0.9
"""Share of a rim's key points in a vertex's weights from which it moves with the rim."""
_LABEL_SHARE = 1e-3
"""Weight of a rim's key points beside its surface: they hold what a surface leaves free."""
_FARTHEST = 0.15
"""Part of the rim's size by which surfaces may move its key points: more fits by chance."""

_DESIGNS_DEG = np.array([[0.0, 20.0], [-5.0, 10.0]])
"""Least and greatest angle of designs: of rims turned back around the face, from flat fronts to wraparounds;
of temples outward from hinge to tip: let back to 90 to 95 degrees, as much more for curves."""


@dataclass(frozen=True)
class FrontHalves:
    """How the two halves of a front lie to each other.

    `reflection` (4, 4) mirrors the frame about its plane of symmetry; `left_from_mirrored` (4, 4), rigid,
    then lays the mirrored right rim on the left one. `apart` is the root mean square distance of the
    surfaces, NaN where only key points were compared.
    """

    reflection: FloatArray
    left_from_mirrored: FloatArray
    apart: float

    @property
    def sides(self) -> tuple[FloatArray, FloatArray]:
        """(4, 4) rigid transforms of the left and the right half after which they mirror each other."""
        # The rigid H with H H = left_from_mirrored, which turns by less than half a turn.
        turn = (Rotation.from_matrix(self.left_from_mirrored[:3, :3]) ** 0.5).as_matrix()
        half = compose(turn, np.linalg.solve(np.eye(3) + turn, self.left_from_mirrored[:3, 3]))
        mirror = self.reflection
        return np.asarray(np.linalg.inv(half), float), mirror @ half @ np.linalg.inv(mirror)

    @property
    def bend_deg(self) -> float:
        """By how much one half is turned against the other."""
        left, right = self.sides
        return float(np.rad2deg(rotation_angle_rad(left[:3, :3] @ right[:3, :3].T)))


def front_halves(
    vertices: FloatArray, faces: IntArray, weights: FloatArray, points: FloatArray
) -> FrontHalves | None:
    """Return how the halves of a frame's front lie; None where too few key points (20, 3) mirror each other.

    Key points, then surfaces (iterated closest points) lay the mirrored right rim on the left one.
    """
    reflection = _reflection(points)
    if reflection is None:
        return None
    rim = RIMS[0][finite_rows(points + points[MIRROR])[RIMS[0]]]
    source, target = transform_points(reflection, points[MIRROR[rim]]), points[rim]
    if not is_posable(target):
        return FrontHalves(reflection, np.eye(4), np.nan)
    start = procrustes(source, target)
    own, other = (weights[:, rim_points].sum(1) for rim_points in RIMS)
    surface = faces[(own[faces] >= 0.5).all(1)]
    moving = transform_points(reflection, vertices[other >= _OWN])
    # With fewer vertices or faces than key points, these alone are compared.
    if min(len(surface), len(moving)) < len(points):
        return FrontHalves(reflection, start, np.nan)
    moving = moving[:: -(-len(moving) // 1000)]
    query, normals = ClosestPointQuery(vertices, surface), face_normals(vertices, surface)
    held = np.repeat([0.0, 1.0], [len(moving), len(source)])

    def pairs(_: Alignment, placed: FloatArray) -> Pairs:
        hits = query.query(placed[held == 0])
        # What one rim has and the other lacks does not pull.
        reach = 3 * np.median(hits.distance)
        trust = tukey_weights(hits.distance, max(reach, SMALLEST))
        pull = np.full(len(source), _LABEL_SHARE * trust.sum() / len(source))
        goal = np.concatenate([hits.points, target])
        normal = np.concatenate([normals[hits.face], np.zeros_like(source)])
        return Pairs(goal - placed, normal, np.concatenate([trust, pull]), held)

    size, center = float(np.linalg.norm(np.ptp(target, axis=0))), moving.mean(0)
    own, first = np.concatenate([moving, source]) - center, transform_points(start, center)
    initial, settled = Similarity(start[:3, :3], first), 1e-6 * size
    equal = np.ones(len(held))
    found = align(own, equal, pairs, initial, steps=30, scale_range=(1.0, 1.0), settled=settled).pose
    pose = compose(found.rotation, found.translation - found.rotation @ center)
    moved = norms(transform_points(pose, source) - transform_points(start, source))
    if moved.max() > _FARTHEST * size:
        return FrontHalves(reflection, start, np.nan)
    distance = query.query(transform_points(pose, moving)).distance
    return FrontHalves(reflection, pose, rms(distance))


def unbent_transforms(points: FloatArray, halves: FrontHalves | None) -> FloatArray:
    """Return (20, 4, 4) rigid transforms of key points (20, 3), NaN for missing ones, that undo the bend.

    With F the reflection and Q = `left_from_mirrored`, the left rim and its hinge move by Q^-1/2, those of
    the right side by F Q^1/2 F. The bridge follows both by half. Bones of the temples keep their lengths, and
    take the mean direction of both sides.
    """
    if halves is None:
        return identities(len(points), 4)
    sides, targets = halves.sides, points.copy()
    for side, rim, temple in zip(sides, RIMS, _TEMPLES, strict=True):
        for part in (rim, temple):
            targets[part] = transform_points(side, points[part])
    targets[:2] = np.mean([transform_points(side, points[:2]) for side in sides], axis=0)
    # Temples run in the mean direction of both sides; one whose counterpart is not known stays.
    reflect, bent = halves.reflection[:3, :3], targets.copy()
    for temple in _TEMPLES:
        for a, b in itertools.pairwise(temple[finite_rows(bent[temple])]):
            bone, other = bent[b] - bent[a], reflect @ (bent[MIRROR[b]] - bent[MIRROR[a]])
            if all_finite(other):
                bone = np.linalg.norm(bone) * normalized(normalized(bone) + normalized(other))
            targets[b] = targets[a] + bone
    rigid = align_key_points(points, targets)
    result = turned_translations(transform_points(rigid, points), targets) @ rigid
    turn = Rotation.from_matrix([side[:3, :3] for side in sides]).mean().as_matrix()
    for k in (0, 1):
        result[k] = compose(turn, targets[k] - turn @ points[k])
    for side, rim, temple in zip(sides, RIMS, _TEMPLES, strict=True):
        result[rim] = result[temple[0]] = side
    # Key points that the frame lacks weigh nothing; NaN times nothing would still be NaN.
    result[~finite_rows(points)] = rigid
    return result


def common_bend(points_mm: FloatArray, reflection: FloatArray) -> str:
    """Return what both sides of key points (20, 3) may be bent to alike, "" where not both are known.

    Rims turn back at the bridge, temples outward at the hinge and in a bow behind it. No symmetry tells these
    from the design: how much is a bend is known up to the spread of designs (`_DESIGNS_DEG`).
    """
    mean_deg, deviation = _DESIGNS_DEG.mean(1), np.ptp(_DESIGNS_DEG, axis=1) / np.sqrt(12)
    across = np.linalg.svd(np.eye(3) - reflection[:3, :3])[0][:, 0]
    image = transform_points(reflection, points_mm[MIRROR])
    even, out = (points_mm + image) / 2, (points_mm - points_mm[MIRROR]) @ across / 2
    side = np.sign(np.nansum(out[RIMS[0]]) + np.nansum(out[_TEMPLES[0]]))
    top, _, inner, bottom, outer = even[RIMS[0]]
    wrap = np.rad2deg(np.arcsin(side * normalized(np.cross(outer - inner, top - bottom)) @ across))
    said, temple = [], _TEMPLES[0][finite_rows(even[_TEMPLES[0]])]
    if np.isfinite(wrap):
        spread, bend = f"+- {deviation[0]:.1f}", f"so the bend is {wrap - mean_deg[0]:+.1f}"
        designs = f"of designs {mean_deg[0]:.1f} {spread}, {bend} {spread} degrees"
        said.append(f"the rims are turned back by {wrap:.1f} degrees, {designs}")
    if len(temple) > 1:
        place, way = even[temple], side * (out[temple] - out[temple[0]])
        length = np.linalg.norm(place[-1] - place[0])
        run = np.cumsum(norms(np.diff(place[:3], axis=0)))
        bow = f", bowed outward by {way[1] - way[2] * run[0] / run[1]:.1f} mm" if len(temple) > 2 else ""
        said.append(
            f"the temples lean {np.rad2deg(np.arcsin(way[-1] / length)):.1f} degrees outward, "
            f"{way[-1]:.1f} mm at their ends{bow}, of designs {mean_deg[1]:.1f} +- {deviation[1]:.1f} "
            f"degrees, so the bend is {way[-1] - length * np.sin(np.deg2rad(mean_deg[1])):+.1f} +- "
            f"{length * np.deg2rad(deviation[1]):.1f} mm"
        )
    return "; ".join(said)


def symmetric_key_points(points: FloatArray, reflection: FloatArray | None = None) -> FloatArray:
    """Return the mean of key points (20, 3) and their mirror image, themselves where one is missing.

    The `reflection` (4, 4) is their own when omitted; where they fix none, they are returned.
    """
    reflection = _reflection(points) if reflection is None else reflection
    if reflection is None:
        return points
    image = transform_points(reflection, points[MIRROR])
    return np.where(np.isfinite(image), (points + image) / 2, points)


def _reflection(points: FloatArray) -> FloatArray | None:
    """Return the (4, 4) that mirrors key points (20, 3); None where too few have a counterpart."""
    image = (points * [-1.0, 1.0, 1.0])[MIRROR]
    both = finite_rows(image) & finite_rows(points)
    if not is_posable(points[both]):
        return None
    return procrustes(image[both], points[both]) @ np.diag([-1.0, 1, 1, 1])
