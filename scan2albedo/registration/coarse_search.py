"""Coarse search: thousands of small robust ICPs all over the scan, thinned in two rounds to a few poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.alignment import align_on_grid
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import super_fibonacci_rotations
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.scan_preparation import PreparedScan
from scan2albedo.registration.template import Template


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
    # Samples, steps, and first and last scale: of the search from every start, and from the best.
    for count, steps, sigma_mm in ((60, 4, (20.0, 10.0)), (200, 8, (12.0, 5.0))):
        model, scores = template.first(count).samples, list[FloatArray]()
        rotations, translations = poses.rotations.copy(), poses.translations.copy()
        for begin in range(0, len(poses), 128):
            if begin and meter.exhausted:
                break
            block = slice(begin, begin + 128)
            moving = rotations[block], translations[block]
            scores.append(align_on_grid(scan.grid, model, *moving, steps=steps, sigma=sigma_mm))
            meter.count(len(scores[-1]))
        order = np.argsort(-np.concatenate(scores), kind="stable")[: options.kept_starts]
        poses = Poses(rotations[order], translations[order])
    # Of every group of like poses, within 8 degrees and 10 mm, the first; at most 160.
    same_trace, kept, alike = 1 + 2 * np.cos(np.deg2rad(8)), list[int](), np.zeros(len(poses), bool)
    for i in range(len(poses)):
        if alike[i] or len(kept) == 160:
            continue
        kept.append(i)
        offset = poses.translations[i + 1 :] - poses.translations[i]
        trace = np.einsum("nij,ij->n", poses.rotations[i + 1 :], poses.rotations[i])
        near = np.einsum("ni,ni->n", offset, offset) < 10**2
        alike[i + 1 :] |= near & (trace > same_trace)
    return poses.subset(np.array(kept, np.int64))


def anchored_starts(anchors: OrientedPoints, front: FloatArray, rotation_count: int) -> Poses:
    """Put the model's `front` (3,) on the scan's anchors, in every rotation facing outward there.

    Of `rotation_count` super-Fibonacci rotations those are tried with +z within 35 degrees of the normal.
    """
    rotations = super_fibonacci_rotations(rotation_count)
    anchor, rotation = np.nonzero(anchors.normals @ rotations[:, :, 2].T >= np.cos(np.deg2rad(35)))
    turned = rotations[rotation]
    return Poses(np.ascontiguousarray(turned), np.ascontiguousarray(anchors.points[anchor] - turned @ front))
