"""Cameras stand where head poses say, flashes where their cameras do."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.pinhole import project
from scan2albedo.reflectance import CaptureRig, rig_of_head_poses

INTRINSICS = np.array([[800.0, 0, 320], [0, 810, 240], [0, 0, 1]])


ROTATIONS = Rotation.from_euler("yx", [[0.3, 0.1], [-0.5, 0.2], [0, 0]]).as_matrix()
SHIFTS = np.array([[5.0, -3, 700], [0, 10, 650], [1, 2, 800]])


def rig_of(**changes):
    given = {"rotations": ROTATIONS, "translations": SHIFTS, "intrinsics": INTRINSICS}
    return rig_of_head_poses(**{**given, "view": [0, 1], "flash": [0, 1], **changes})


def test_centres_are_minus_r_transposed_t_and_points_land_where_the_pose_puts_them():
    rig = rig_of(view=[0, 1, 2, 0], flash=[0, 1, 2, 2])
    centers = np.stack([-r.T @ t for r, t in zip(ROTATIONS, SHIFTS, strict=True)])
    assert_allclose(rig.camera_positions, centers[[0, 1, 2, 0]], atol=1e-9)
    assert_allclose(rig.light_positions, centers[[0, 1, 2, 2]], atol=1e-9)
    assert rig.light.tolist() == [0, 1, 2, 2]
    point = np.array([10.0, 20, 30])
    image = INTRINSICS @ (ROTATIONS[1] @ point + SHIFTS[1])
    pixels, depth = project(rig.cameras[1], point[None])
    assert_allclose(pixels[0], image[:2] / image[2])
    assert_allclose(depth, image[2])


def test_intrinsics_may_differ_from_camera_to_camera():
    several = np.stack([INTRINSICS, 2 * np.eye(3) * [1, 1, 0.5], INTRINSICS])
    assert_allclose(rig_of(intrinsics=several).cameras[1, :, :3], several[1] @ ROTATIONS[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotations": np.stack([np.diag([1.0, 1, -1])] * 3)}, "head pose 0 has no proper rotation"),
        ({"rotations": np.stack([2 * np.eye(3)] * 3)}, "head pose 0"),
        ({"rotations": np.full((3, 3, 3), np.nan)}, "head pose 0"),
        ({"translations": np.zeros((2, 3))}, r"translations is \(2, 3\), expected \(3, 3\)"),
        ({"view": [0, 3]}, "view reaches 0 to 3 of 3 poses"),
        ({"flash": [0, -1]}, "flash reaches -1"),
        ({"flash": [0.0, 1.0]}, "flash is float64"),
        ({"flash": [0]}, r"expected int \(2,\)"),
    ],
)
def test_poses_that_do_not_fit_are_refused(change, message):
    with pytest.raises(ReflectanceError, match=message):
        rig_of(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": np.zeros((1, 3, 4))}, "singular"),
        ({"light_positions": np.zeros((2, 3))}, "light_positions is"),
        ({"light_positions": np.full((1, 3), np.nan)}, "finite"),
        ({"light": np.array([-1])}, "light is"),
    ],
)
def test_rigs_that_do_not_fit_are_refused(change, message):
    good = {"cameras": np.eye(3, 4)[None], "light_positions": np.zeros((1, 3)), "light": np.array([0])}
    with pytest.raises(ReflectanceError, match=message):
        CaptureRig(**good | change)
