"""Rigid poses (4, 4) beside each other, and scans moved by them."""

import numpy as np

from scan2albedo import RawScan
from scan2albedo.geometry.rigid import Similarity, invert_rigid, rotation_angle_rad, transform_points

REST = Similarity(np.eye(3), np.zeros(3))


def assert_near(found, expected, degrees, millimetres):
    """Two poses differ by less than an angle, and by less than a distance at the origin of their target."""
    change = found @ invert_rigid(expected)
    assert np.degrees(rotation_angle_rad(change[:3, :3])) < degrees
    assert np.linalg.norm(change[:3, 3]) < millimetres


def moved(scan, pose):
    """Return a scan, without its colours, moved by a pose."""
    return RawScan(transform_points(pose, scan.vertices), scan.faces, name=scan.name)
