"""The scan's principal frame goes with the scan."""

import numpy as np
import pytest
from helpers.meshes import sphere
from numpy.testing import assert_allclose

from scan2albedo.geometry.rigid import compose, in_principal_frame, random_rotation, transform_points


@pytest.fixture(scope="module")
def lump():
    unit, faces = sphere(3, 1.0)
    stretched = unit * [50.0, 70.0, 90.0] * (1 + 0.3 * np.clip(unit @ [0.6, 0.5, 0.62], 0, 1))[:, None] ** 2
    return stretched, faces


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("reach_mm", [300.0, 1e6])
def test_any_pose_arrives_at_the_same_coordinates(lump, seed, reach_mm):
    vertices, faces = lump
    rng = np.random.default_rng(seed)
    pose = compose(random_rotation(rng), rng.uniform(-reach_mm, reach_mm, 3))
    rest, prepared_from_rest = in_principal_frame(vertices, faces)
    assert_allclose(transform_points(prepared_from_rest, vertices), rest, atol=1e-10)
    moved, prepared_from_scan = in_principal_frame(transform_points(pose, vertices), faces)
    assert_allclose(moved, rest, atol=1e-14 * reach_mm + 1e-9)
    assert_allclose(prepared_from_scan[:3, :3] @ prepared_from_scan[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(prepared_from_scan[:3, :3]) == pytest.approx(1)


def test_a_surface_without_area_is_only_moved():
    moved, prepared_from_scan = in_principal_frame(np.full((3, 3), 7.0), np.array([[0, 1, 2]]))
    assert not moved.any()
    assert prepared_from_scan[:3, :3].tolist() == np.eye(3).tolist()
