"""Starting poses for the rigid search: rotations spread over SO(3), anchored where the scan has surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rigid import super_fibonacci_rotations
from scan2albedo.registration.oriented_points import OrientedPoints, farthest_points

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Starts:
    """`scan_from_model` starts: `rotations` (N, 3, 3) and `translations` (N, 3) in mm."""

    rotations: FloatArray
    translations: FloatArray

    def __len__(self) -> int:
        return len(self.rotations)


def anchored_starts(
    scan: OrientedPoints,
    model_anchor: FloatArray,
    *,
    rotation_count: int,
    anchor_spacing_mm: float,
    anchor_limit: int,
    cone_rad: float,
    smoothing_mm: float,
) -> Starts:
    """Put the model's front point on well-spread scan points, in every rotation that faces outward there.

    A face may lie anywhere on a scan that also holds shoulders and hair, so centroids say little;
    but its front always is a piece of surface whose averaged normal is roughly the face's +z axis.

    Parameters
    ----------
    scan : OrientedPoints
    model_anchor : (3,) float64
        The front of the model, in the model's frame.
    rotation_count : int
        Super-Fibonacci rotations of which each anchor takes those within the cone.
    anchor_spacing_mm, anchor_limit : float, int
        Least distance between two anchors and their greatest number.
    cone_rad : float
        Greatest angle between the rotated +z axis and the averaged normal.
    smoothing_mm : float
        Radius over which normals are averaged.
    """
    anchors = farthest_points(scan.points, anchor_spacing_mm, anchor_limit)
    tree = cKDTree(scan.points)
    around = tree.query_ball_point(scan.points[anchors], smoothing_mm)
    outward = normalized(np.array([(scan.normals[i] * scan.areas[i, None]).sum(0) for i in around]))
    rotations = super_fibonacci_rotations(rotation_count)
    facing = outward @ rotations[:, :, 2].T >= np.cos(cone_rad)
    anchor, rotation = np.nonzero(facing)
    turned = rotations[rotation]
    translations = scan.points[anchors[anchor]] - turned @ model_anchor
    return Starts(np.ascontiguousarray(turned), np.ascontiguousarray(translations))
