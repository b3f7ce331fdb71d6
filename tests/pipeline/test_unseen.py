"""A face that its pictures showed in part: the rest is filled and marked, and nothing follows from it."""

from dataclasses import replace

import numpy as np
import pytest

from scan2albedo import load_scan, process
from scan2albedo.geometry.rasterization import rasterize_uv

SIZE = 128


@pytest.fixture(scope="module")
def scan(shared_data):
    return load_scan(shared_data / "james.obj", unit="mm")


@pytest.fixture(scope="module")
def unpainted(scan, shared_data):
    """Make the scan whose pictures showed no hole in a cheek, which has one linear colour."""
    picked = np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    away = np.linalg.norm(scan.vertices - 0.45 * picked[2] - 0.55 * picked[31], axis=1)
    corners = scan.uv[(away < 24)[scan.faces].all(1)].reshape(-1, 2)
    faces = np.arange(len(corners)).reshape(-1, 3)
    hole = rasterize_uv(corners, faces, scan.texture_linear.shape[:2]).covered

    def filled(color_linear):
        texture = np.where(hole[..., None], np.float32(color_linear), scan.texture_linear)
        return replace(scan, texture_linear=texture, color_seen=~hole)

    return filled


def test_what_no_picture_showed_is_filled_and_marked(scan, unpainted):
    scans = scan, unpainted((1, 0.2, 0))
    plain, result = (process(given, size=SIZE, quality="draft", skip=("albedo",)) for given in scans)
    assert plain.scan.color_seen is None
    assert plain.geometry_image.filled is None
    assert not plain.plan.of_stage("geometry_image.filled")
    image, filled = result.geometry_image, result.geometry_image.filled
    assert 100 < filled.sum() < 400
    assert not image.seen[filled].any()
    assert image.skin[filled].max() == 0
    (doubt,) = result.plan.doubts().of_stage("geometry_image.filled")
    assert "no picture showed 1." in doubt.reason
    apart = np.linalg.norm(result.fitted.landmarks - plain.fitted.landmarks, axis=1)
    assert apart.max() < 0.3


@pytest.mark.slow
def test_light_and_albedo_do_not_see_what_fills_the_hole(scan, unpainted):
    scans = scan, unpainted((1, 0.2, 0)), unpainted((0, 0, 0))
    whole, orange, black = (process(given, size=2 * SIZE) for given in scans)
    filled, seen = orange.geometry_image.filled, orange.geometry_image.seen
    assert orange.albedo.confidence[filled].max() == 0
    np.testing.assert_allclose(orange.albedo.albedo_linear[seen], black.albedo.albedo_linear[seen], atol=1e-4)
    # A cheek less is another picture: two lamps that explain it about as well may change places, so that not
    # their directions are compared but what their light leaves, which has one factor that nobody knows.
    ratio = orange.albedo.albedo_linear / np.maximum(whole.albedo.albedo_linear, 1e-4)
    both = seen & whole.geometry_image.seen
    factor = np.median(ratio[both])
    assert np.median(np.abs(ratio[both] / factor - 1)) < 0.04
    inside = filled & whole.geometry_image.seen
    assert np.median(np.abs(ratio[inside] / factor - 1)) < 0.15
