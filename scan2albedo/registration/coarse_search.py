"""Coarse search: thousands of starting poses all over the scan, thinned in two rounds to a few."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import super_fibonacci_rotations
from scan2albedo.registration.grid_icp import NearestGrid, refine_on_grid
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.scan_preparation import PreparedScan
from scan2albedo.registration.template import Template

_CONE_RAD = np.deg2rad(35.0)
"""Greatest angle between the model's +z axis and the averaged outward normal at an anchor."""
_BLOCK = 128
_DISTINCT_POSES = 160
_SAME_ROTATION_RAD = np.deg2rad(8)
_SAME_POSITION_MM = 10.0


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

    Round 1 runs `coarse_iterations` (4) on 60 model samples from every start; the best `kept_starts` go on to
    as many (8) on 200 samples with a tighter scale. The meter counts one evaluation a start and round; when
    its budget ends, the poses tried so far are ranked.
    """
    poses = anchored_starts(scan.anchors, template.front, options.rotation_count)
    # In random order a budget that ends early has still seen starts from all over the scan.
    poses = poses.subset(np.random.default_rng(seed).permutation(len(poses)))
    first, second = options.coarse_iterations
    poses = _round(scan.grid, template.first(60), poses, first, (20.0, 10.0), meter)
    poses = poses.subset(np.arange(min(options.kept_starts, len(poses))))
    poses = _round(scan.grid, template.first(200), poses, second, (12.0, 5.0), meter)
    return _distinct(poses, _DISTINCT_POSES)


def anchored_starts(anchors: OrientedPoints, front: FloatArray, rotation_count: int) -> Poses:
    """Put the model's `front` (3,) on the scan's anchors, in every rotation facing outward there.

    A face may be anywhere on a scan with shoulders and hair, so centroids are of little use; but the averaged
    normal at its front is roughly its +z axis. `rotation_count` super-Fibonacci rotations are tried at
    each anchor.
    """
    rotations = super_fibonacci_rotations(rotation_count)
    facing = anchors.normals @ rotations[:, :, 2].T >= np.cos(_CONE_RAD)
    anchor, rotation = np.nonzero(facing)
    turned = rotations[rotation]
    translations = anchors.points[anchor] - turned @ front
    return Poses(np.ascontiguousarray(turned), np.ascontiguousarray(translations))


def _round(
    grid: NearestGrid,
    model: OrientedPoints,
    starts: Poses,
    iterations: int,
    sigma_mm: tuple[float, float],
    meter: Meter,
) -> Poses:
    """Refine the starts block by block while the budget lasts; return those tried, best first."""
    rotations, translations = starts.rotations.copy(), starts.translations.copy()
    scores: list[FloatArray] = []
    for begin in range(0, len(starts), _BLOCK):
        if begin and meter.exhausted:
            break
        block = slice(begin, begin + _BLOCK)
        scores.append(
            refine_on_grid(
                grid,
                model,
                model.areas,
                rotations[block],
                translations[block],
                iterations=iterations,
                sigma_mm=sigma_mm,
            )
        )
        meter.count(len(scores[-1]))
    order = np.argsort(-np.concatenate(scores), kind="stable")
    return Poses(rotations[order], translations[order])


def _distinct(poses: Poses, count: int) -> Poses:
    """Keep the first of every group of like poses, at most `count`."""
    same_trace = 1 + 2 * np.cos(_SAME_ROTATION_RAD)
    kept: list[int] = []
    alike = np.zeros(len(poses), bool)
    for i in range(len(poses)):
        if alike[i]:
            continue
        kept.append(i)
        if len(kept) == count:
            break
        offset = poses.translations[i + 1 :] - poses.translations[i]
        trace = np.einsum("nij,ij->n", poses.rotations[i + 1 :], poses.rotations[i])
        near = np.einsum("ni,ni->n", offset, offset) < _SAME_POSITION_MM**2
        alike[i + 1 :] |= near & (trace > same_trace)
    return poses.subset(np.array(kept, np.int64))
