"""Coarse search: small robust ICPs all over the scan, thinned to a few poses; poses by landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray, dots, norms
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.alignment import NearestGrid, align_on_grid
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import Similarity, procrustes, super_fibonacci_rotations, transform_points
from scan2albedo.registration.inputs import PreparedScan, RegistrationOptions, Template


@dataclass(frozen=True)
class Poses:
    """`scan_from_model` poses: `rotations` (N, 3, 3) and `translations` (N, 3) in mm."""

    rotations: FloatArray
    translations: FloatArray

    def __len__(self) -> int:
        return len(self.rotations)

    def subset(self, index: IntArray) -> Poses:
        """Return the poses at `index`."""
        return Poses(self.rotations[index], self.translations[index])


def coarse_poses(
    scan: PreparedScan, template: Template, options: RegistrationOptions, meter: Meter, seed: int
) -> Poses:
    """Return distinct poses that place the model near the scan's surface, the nearest first.

    The best `kept_starts` of the first round go on to the second; each start and round is one evaluation.
    """
    poses = anchored_starts(scan.anchors, template.front, 200)
    # In random order a budget that ends early has still seen starts from all over the scan.
    poses = poses.subset(np.random.default_rng(seed).permutation(len(poses)))
    grid = NearestGrid.of(scan.samples, cell=6, margin=40)
    # Samples, steps, and first and last scale: of the search from every start, and from the best.
    for count, steps, sigma_mm in ((60, 4, (20.0, 10.0)), (200, 8, (12.0, 5.0))):
        model, scores = template.first(count).samples, list[FloatArray]()
        rotations, translations = poses.rotations.copy(), poses.translations.copy()
        for begin in range(0, len(poses), 128):
            if begin and meter.exhausted:
                break
            block = slice(begin, begin + 128)
            moving = rotations[block], translations[block]
            scores.append(align_on_grid(grid, model, *moving, steps=steps, sigma=sigma_mm))
            meter.count(len(scores[-1]))
        order = np.argsort(-np.concatenate(scores), kind="stable")[: options.kept_starts]
        poses = Poses(rotations[order], translations[order])
    # Of every group of like poses, within 8 degrees and 10 mm, the first; at most 160.
    same_trace, kept, duplicate = 1 + 2 * np.cos(np.deg2rad(8)), list[int](), np.zeros(len(poses), bool)
    for i in range(len(poses)):
        if duplicate[i] or len(kept) == 160:
            continue
        kept.append(i)
        offset = poses.translations[i + 1 :] - poses.translations[i]
        trace = np.einsum("nij,ij->n", poses.rotations[i + 1 :], poses.rotations[i])
        near = dots(offset, offset) < 10**2
        duplicate[i + 1 :] |= near & (trace > same_trace)
    return poses.subset(np.array(kept, int))


def anchored_starts(anchors: OrientedPoints, front: FloatArray, rotation_count: int) -> Poses:
    """Put the model's `front` (3,) on the scan's anchors, in every rotation facing outward there.

    Of `rotation_count` super-Fibonacci rotations those are tried with +z within 35 degrees of the normal.
    """
    rotations = super_fibonacci_rotations(rotation_count)
    anchor, rotation = np.nonzero(anchors.normals @ rotations[:, :, 2].T >= np.cos(np.deg2rad(35)))
    turned = rotations[rotation]
    return Poses(np.ascontiguousarray(turned), np.ascontiguousarray(anchors.points[anchor] - turned @ front))


_PERSON_MM = 6.0
"""Standard deviation along an axis between a person's landmarks and the model's in the same pose and size."""
_ELSEWHERE_MM = 40.0
"""Standard deviation along an axis of a point that has nothing to do with the landmark, but lies on the
face."""
_WRONG = 0.1
"""Part of landmarks that are taken to be wrong."""
_SCALES = (0.6, 1.6)


@dataclass(frozen=True)
class PlacedPose:
    """At least three landmarks in no line: of the model in its frame, and of the prepared scan, (L, 3) mm."""

    of_model: FloatArray
    of_scan: FloatArray

    @classmethod
    def of(cls, scan: PreparedScan, model: AnnotatedSurface) -> PlacedPose | None:
        """Return the landmarks of a scan; None where they are too few to show a pose."""
        placed, of_model = scan.raw.landmarks, model.landmarks
        if placed is None or of_model is None:
            return None
        used = placed.placed
        found = cls(of_model[used], transform_points(scan.prepared_from_scan, placed.points[used]))
        return found if len(found.triples()) else None

    def triples(self) -> list[tuple[int, int, int]]:
        """Return at most 200 triples that span a triangle, the same ones each time."""
        every = list(combinations(range(len(self.of_model)), 3))
        if not every:
            return []
        corners = np.stack([self.of_model, self.of_scan])[:, every]
        across = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        # Nearly straight ones, of less than 300 mm2, leave a turn open.
        wide = np.flatnonzero(norms(across).min(0) > 600)
        if len(wide) > 200:
            wide = wide[np.random.default_rng(0).choice(len(wide), 200, replace=False)]
        return [every[i] for i in wide]

    def start(self) -> Poses:
        """Return the pose, one, with which most landmarks agree whatever the others say."""

        def fitted(weight: FloatArray) -> Similarity:
            matrix = procrustes(self.of_model, self.of_scan, weights=weight, scale=True)
            scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
            return Similarity(matrix[:3, :3] / scale, matrix[:3, 3], scale)

        def loss(pose: Similarity) -> float:
            squared = self._squared(pose)
            outside = not _SCALES[0] < pose.scale < _SCALES[1]
            return float(np.sum(squared / (1 + squared))) + outside * len(squared)

        corners = np.eye(len(self.of_model))
        best = min((fitted(corners[list(triple)].sum(0)) for triple in self.triples()), key=loss)
        for _ in range(4):
            refitted = fitted(1 / (1 + self._squared(best)))
            if loss(refitted) >= loss(best):
                break
            best = refitted
        rigid = best.rigid(self.of_model.mean(0))
        return Poses(rigid[None, :3, :3], rigid[None, :3, 3])

    def log_odds(self, scan_from_model: Similarity) -> float:
        """Return what the landmarks say for a pose: how much likelier they are than points anywhere.

        What they say against one is capped: another scan's landmarks must not refuse a face.
        """
        ratio = (_ELSEWHERE_MM / _PERSON_MM) ** 3 * np.exp(-0.5 * self._squared(scan_from_model))
        odds = float(np.log(_WRONG + (1 - _WRONG) * ratio).sum())
        # A pose with its size has seven numbers: as many coordinates agree with any landmarks.
        coordinates = self.of_model.size
        return max(odds * max(coordinates - 7, 0) / coordinates, -2.0)

    def _squared(self, pose: Similarity) -> FloatArray:
        return np.sum((pose.apply(self.of_model) - self.of_scan) ** 2, axis=1) / _PERSON_MM**2
