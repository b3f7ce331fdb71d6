"""The annealed pose counts only where the surface is nearer for it."""

import numpy as np
import pytest

from scan2albedo.core import Meter
from scan2albedo.geometry.rigid import invert_rigid, rotation_angle_rad, rotation_from_vector
from scan2albedo.registration import RegistrationOptions
from scan2albedo.registration.candidates import ScanView, rigid_distance_mm
from scan2albedo.registration.finish import Tightened, annealed
from scan2albedo.registration.oriented_points import oriented_points
from scan2albedo.registration.robust_icp import ScanTree, SimilarPose
from scan2albedo.registration.template import Template


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("off_deg", [0.0, 1.0, 4.0, 25.0])
def test_annealing_never_leaves_the_surface_farther_than_it_was(synthetic_scan, model, seed, off_deg):
    example = synthetic_scan(seed)
    vertices, faces = example.scan.vertices, example.scan.faces
    view = ScanView(vertices, faces, ScanTree.of(oriented_points(vertices, faces, 4.0)))
    template = Template.of(model, 6.0, 0)
    truth = invert_rigid(example.model_from_scan)
    turn = rotation_from_vector(np.radians(off_deg) * np.array([0.6, -0.64, 0.48]))
    start = SimilarPose(truth[:3, :3] @ turn, truth[:3, 3] + [0.5 * off_deg, 0, 0])
    meter = Meter("depth_annealing", "objective")
    unsettled = Tightened(start, 1.0, np.inf)
    options = RegistrationOptions(force_annealing=True)
    found = annealed(view, template, unsettled, options, meter, 0)
    for sigma_mm in (0.5, 2.0):
        before, after = (rigid_distance_mm(view, template, p, sigma_mm) for p in (start, found.pose))
        assert after <= before
    kept = np.array_equal(found.pose.rotation, start.rotation)
    assert ("dropped" in found.note[2]) == kept
    if off_deg == 4.0:
        assert np.degrees(rotation_angle_rad(found.pose.rotation.T @ truth[:3, :3])) < 3.9
