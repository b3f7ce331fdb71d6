"""Real harmonics against scipy, their own orthonormality, and finite differences; the poles above all."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import sph_harm_y

from scan2albedo.lighting.harmonics import harmonics, harmonics_gradient

POLES = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])


def unit_vectors(count, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    near_poles = POLES[[0, 1, 0, 1]] + 1e-9 * vectors[:4]
    near_camera_axis = np.array([0.0, 0.0, 1.0]) + 0.05 * vectors[4:40]
    every = np.concatenate([vectors, near_poles, near_camera_axis, POLES, np.eye(3), -np.eye(3)])
    return every / np.linalg.norm(every, axis=1, keepdims=True)


def scipy_harmonics(unit):
    polar = np.arctan2(np.hypot(unit[:, 0], unit[:, 1]), unit[:, 2])
    azimuth = np.arctan2(unit[:, 1], unit[:, 0])
    degree = np.repeat(np.arange(9), 2 * np.arange(9) + 1)
    m = np.arange(81) - degree * (degree + 1)
    values = (-1.0) ** m * sph_harm_y(degree, abs(m), polar[:, None], azimuth[:, None])
    return np.where(m < 0, values.imag, values.real) * np.where(m, np.sqrt(2), 1)


def test_harmonics_agree_with_scipy_everywhere():
    unit = unit_vectors(500)
    assert_allclose(harmonics(unit), scipy_harmonics(unit), rtol=0, atol=1e-13)


def test_gradients_agree_with_finite_differences_along_the_sphere():
    unit = unit_vectors(60, seed=1)
    tangent = np.cross(unit, np.random.default_rng(2).normal(size=unit.shape))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    step = 1e-5
    ahead, behind = (harmonics(np.cos(step) * unit + s * np.sin(step) * tangent) for s in (1, -1))
    slope = np.einsum("vkd,vd->vk", harmonics_gradient(unit), tangent)
    assert_allclose(slope, (ahead - behind) / (2 * step), atol=2e-8)
    assert_allclose(np.einsum("vkd,vd->vk", harmonics_gradient(unit), unit), 0, atol=1e-13)


@pytest.mark.parametrize(
    ("direction", "order", "message"),
    [([0.0, 1.0], 2, r"direction is \(2,\)"), ([np.nan, 0, 1], 2, "NaN"), ([0.0, 0, 1], -1, "order")],
)
def test_what_does_not_fit_is_refused(direction, order, message):
    with pytest.raises(ValueError, match=message):
        harmonics(direction, order)
