"""Normals that are off cost neither the albedo nor the honesty of its intervals."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.reflectance_errors import diffuse_error
from worlds.flash_captures import head_capture, samples_of

from scan2albedo.reflectance import ReflectanceFitOptions, fit_reflectance, point_light_lobes
from scan2albedo.reflectance.point_light_lobes import tilted_normals


@pytest.fixture(scope="module")
def capture():
    return head_capture(1500)


@pytest.fixture(scope="module")
def fit(capture):
    return fit_reflectance(samples_of(capture, noise=0.01))


@pytest.mark.parametrize("angle", [0.0, 1.0, 3.0])
def test_normals_that_are_off_cost_neither_accuracy_nor_honesty(capture, fit, angle):
    samples = samples_of(capture, noise=0.01, normals_off_deg=angle)
    tilted = fit_reflectance(samples)
    assert diffuse_error(tilted, capture) < 1.2 * diffuse_error(fit, capture)
    sure, truth = tilted.identified, capture.parameters
    inside = (tilted.low <= truth) & (truth <= tilted.high)
    assert 0.93 < inside[sure].mean() < 0.98
    assert np.median(tilted.std[:, :3]) < 1.15 * np.median(fit.std[:, :3])
    found = np.degrees(np.arctan(np.linalg.norm(tilted.tilt, axis=1)))
    assert np.median(found) == pytest.approx(angle, abs=0.15)
    assert np.median(tilted.normal_sigma_degrees) == pytest.approx(angle / np.sqrt(2), abs=0.25)


def test_normals_said_to_be_right_are_not_tilted(capture):
    samples = samples_of(capture, noise=0.01, normals_off_deg=3.0)
    right = fit_reflectance(samples, options=ReflectanceFitOptions(normal_sigma_degrees=0))
    assert (right.tilt == 0).all()
    assert (right.normal_sigma_degrees == 0).all()
    without = fit_reflectance(replace(samples, slopes=None))
    assert np.array_equal(right.parameters, without.parameters)
    assert diffuse_error(right, capture) > 2 * diffuse_error(fit_reflectance(samples), capture)


def test_lobes_of_tilted_normals_are_those_of_the_normals(capture):
    rng = np.random.default_rng(3)
    tilt = 0.1 * rng.standard_normal((1500, 2))
    samples = samples_of(capture)
    turned = tilted_normals(capture.normals, tilt)
    expected = point_light_lobes(capture.vertices, turned, capture.cameras, capture.lights)
    both = (samples.lobes[..., 1] > 0) & (expected[..., 0] > 0)
    np.testing.assert_allclose(samples.turned_lobes(tilt)[both], expected[both], rtol=1e-9, atol=1e-15)
