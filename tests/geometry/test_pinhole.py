"""Pinhole cameras: projection and rays agree, whatever the matrix's scale and sign."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import (
    camera_centers,
    fit_camera,
    look_at,
    normalized_cameras,
    pixel_directions,
    pixel_grid,
    project,
)

CAMERA = look_at([120, 60, 500], [5, -3, 10], focal_px=900, shape=(480, 640), roll_rad=0.3)


def test_the_target_lies_in_the_middle_and_up_is_up():
    pixels, depth = project(CAMERA, np.array([[5.0, -3, 10], [5, 7, 10]]))
    assert_allclose(pixels[0], [319.5, 239.5], atol=1e-9)
    assert pixels[1, 1] < pixels[0, 1]
    assert depth[0] == pytest.approx(np.linalg.norm([115, 63, 490]))


def test_rays_through_pixels_lead_back_to_the_points():
    points = np.random.default_rng(0).normal(0, 60, (50, 3))
    pixels, depth = project(CAMERA, points)
    center = camera_centers(CAMERA[None])[0]
    assert_allclose(center, [120, 60, 500], atol=1e-9)
    assert_allclose(pixel_directions(CAMERA, pixels), normalized(points - center), atol=1e-12)
    assert (depth > 0).all()


@pytest.mark.parametrize("factor", [1.0, -1.0, 1e-6, -250.0])
def test_scale_and_sign_of_a_camera_do_not_matter(factor):
    assert_allclose(normalized_cameras(factor * CAMERA[None])[0], CAMERA, rtol=1e-12, atol=1e-9)


def test_points_behind_have_no_pixel():
    pixels, depth = project(CAMERA, np.array([[240.0, 120, 1000]]))
    assert depth[0] < 0
    assert np.isnan(pixels).all()


def test_the_grid_runs_row_by_row():
    assert pixel_grid((2, 3)).tolist() == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]]


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        (np.zeros((2, 3, 3)), r"\(C, 3, 4\)"),
        (np.full((1, 3, 4), np.nan), "finite"),
        (np.stack([CAMERA, np.zeros((3, 4))]), "camera 1 has a singular"),
    ],
)
def test_bad_cameras_are_refused(cameras, message):
    with pytest.raises(ValueError, match=message):
        normalized_cameras(cameras)


@pytest.mark.parametrize("far", [0.0, 1e5])
def test_a_camera_is_fitted_to_what_it_saw(far):
    points = np.random.default_rng(2).normal(0, 60, (6, 3)) + far
    seen = look_at(np.array([120, 60, 500]) + far, np.full(3, far), focal_px=900, shape=(480, 640))
    (found,) = normalized_cameras(fit_camera(points, project(seen, points)[0])[None])
    assert_allclose(camera_centers(found[None])[0], np.array([120, 60, 500]) + far, rtol=0, atol=1e-3)
    others = np.random.default_rng(3).normal(0, 60, (50, 3)) + far
    assert_allclose(project(found, others)[0], project(seen, others)[0], rtol=0, atol=1e-5)
