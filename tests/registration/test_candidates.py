"""Open3D's part of the candidates: it refines, repeats its bits, and explains itself when it is missing."""

import builtins

import numpy as np
import pytest

from scan2albedo.errors import MissingDependencyError, import_open3d
from scan2albedo.geometry.oriented_points import oriented_points
from scan2albedo.geometry.rigid import compose, rotation_angle_rad, rotation_from_vector
from scan2albedo.registration.candidates import ScanTarget


def test_it_refines_and_repeats_its_bits(model):
    samples = oriented_points(*model.surface(1), 4.0)
    target = ScanTarget(samples)
    start = compose(rotation_from_vector([0.1, -0.05, 0.08]), [6.0, -4.0, 5.0])
    poses = [
        target.refine(samples, start, max_distance_mm=20.0, scale_mm=8.0, iterations=30) for _ in range(4)
    ]
    assert np.degrees(rotation_angle_rad(poses[0][:3, :3])) < 0.1
    assert np.linalg.norm(poses[0][:3, 3]) < 0.1
    assert all(np.array_equal(poses[0], pose) for pose in poses[1:])


@pytest.mark.parametrize(
    "error", [ImportError("libusb-1.0.so.0: cannot open"), OSError("libGL.so.1: cannot open shared object")]
)
def test_a_missing_system_library_is_one_line_with_the_command(monkeypatch, error):
    real_import = builtins.__import__

    def broken(name, *rest):
        if name == "open3d":
            raise error
        return real_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", broken)
    with pytest.raises(MissingDependencyError) as caught:
        import_open3d()
    message = str(caught.value)
    assert "tools/bootstrap_system.sh" in message
    assert "libgl1" in message
    assert str(error) in message
    assert "\n" not in message
