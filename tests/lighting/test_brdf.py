"""Reflectance models against closed forms."""

import numpy as np
import pytest
from brdf_reference import oren_nayar, phong

from scan2albedo.geometry.mesh import normalized


def _cosines():
    """Return the cosines n.l, n.v and l.v of random unit n, l, v."""
    n, light, view = map(normalized, np.random.default_rng(0).standard_normal((3, 4000, 3)))
    return np.sum([n * light, n * view, light * view], axis=2)


def _angles_form(n_l, n_v, l_v, sigma):
    """Oren-Nayar as printed in the paper, with its four angles."""
    theta_i, theta_r = np.arccos(n_l), np.arccos(n_v)
    cos_phi = (l_v - n_l * n_v) / (np.sin(theta_i) * np.sin(theta_r))
    a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    alpha, beta = np.maximum(theta_i, theta_r), np.minimum(theta_i, theta_r)
    return n_l * (a + b * np.maximum(0, cos_phi) * np.sin(alpha) * np.tan(beta))


@pytest.mark.parametrize("sigma", [0.0, 0.1, 0.4, 1.0])
def test_oren_nayar_equals_the_form_with_angles(sigma):
    cosines = _cosines()
    front = cosines[:, (cosines[:2] > 0.02).all(0)]
    assert oren_nayar(*front, sigma) == pytest.approx(_angles_form(*front, sigma), rel=1e-9, abs=1e-12)


def test_phong_peaks_at_one_in_the_mirror_direction():
    assert phong(np.cos(0.4), np.cos(0.4), np.cos(0.8), 50.0) == pytest.approx(1.0)
    assert phong(np.cos(0.4), np.cos(0.3), np.cos(0.7), 50.0) == pytest.approx(np.cos(0.1) ** 50)
    # r.v = 2 * 0.1 * 0.1 - 0.9 < 0: an even power must not turn it into a highlight.
    assert phong(0.1, 0.1, 0.9, 2.0) == 0
