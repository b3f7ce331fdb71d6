"""Reflectance models against closed forms and at their extremes."""

import numpy as np
import pytest
from brdf_reference import lambert, minnaert, oren_nayar, phong
from hypothesis import given
from hypothesis import strategies as st

from scan2albedo.geometry.mesh import normalized

COSINES = np.linspace(-1, 1, 41)


def _triples(least=-1.0):
    """Return cosines of random unit n, l, v, those of n above the least."""
    n, light, view = map(normalized, np.random.default_rng(0).standard_normal((3, 4000, 3)))
    cosines = np.sum([n * light, n * view, light * view], axis=2)
    return cosines[:, (cosines[:2] > least).all(0)]


def _angles_form(n_l, n_v, l_v, sigma):
    """Oren-Nayar as printed in the paper, with its four angles."""
    theta_i, theta_r = np.arccos(n_l), np.arccos(n_v)
    cos_phi = (l_v - n_l * n_v) / (np.sin(theta_i) * np.sin(theta_r))
    a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    alpha, beta = np.maximum(theta_i, theta_r), np.minimum(theta_i, theta_r)
    return n_l * (a + b * np.maximum(0, cos_phi) * np.sin(alpha) * np.tan(beta))


def test_sigma_zero_oren_nayar_is_lambert_exactly():
    n_l, n_v, l_v = _triples()
    assert np.array_equal(oren_nayar(n_l, n_v, l_v, 0.0), lambert(n_l))


@pytest.mark.parametrize("sigma", [0.1, 0.4, 1.0])
def test_oren_nayar_equals_the_form_with_angles(sigma):
    front = _triples(0.02)
    assert oren_nayar(*front, sigma) == pytest.approx(_angles_form(*front, sigma), rel=1e-9, abs=1e-12)


def test_oren_nayar_is_reciprocal():
    n_l, n_v, l_v = _triples(0.01)
    there, back = oren_nayar(n_l, n_v, l_v, 0.6) / n_l, oren_nayar(n_v, n_l, l_v, 0.6) / n_v
    assert there == pytest.approx(back, rel=1e-12)


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 2), st.floats(0.1, 1e4))
def test_every_model_is_finite_and_not_negative(n_l, n_v, l_v, sigma, exponent):
    for value in (
        lambert(n_l),
        oren_nayar(n_l, n_v, l_v, sigma),
        minnaert(n_l, n_v, 0.3 + sigma),
        phong(n_l, n_v, l_v, exponent),
    ):
        assert np.isfinite(value)
        assert value >= 0


@pytest.mark.parametrize(
    "model",
    [
        lambda c: oren_nayar(c, 0.5, 0.1, 0.5),
        lambda c: minnaert(c, 0.5, 0.7),
        lambda c: phong(c, 0.5, -1.0, 2.0),
        lambert,
    ],
)
def test_light_behind_gives_nothing(model):
    assert np.all(model(COSINES[COSINES <= 0]) == 0)
    assert np.all(model(COSINES[COSINES > 0.05]) > 0)


def test_light_and_view_along_the_normal_are_defined():
    assert oren_nayar(1.0, 1.0, 1.0, 0.5) == pytest.approx(1 - 0.5 * 0.25 / 0.58)


@pytest.mark.parametrize("model", [lambda n_l, n_v, l_v: lambert(n_l), lambda *c: oren_nayar(*c, 1.0)])
def test_a_white_surface_reflects_no_more_than_it_receives(model):
    """Integral over v of f cos(theta_r) / pi, for light from straight above to grazing."""
    rng = np.random.default_rng(1)
    z, turn = rng.uniform(0, 1, 200_000), rng.uniform(0, 2 * np.pi, 200_000)
    view = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], 1)
    for angle in np.deg2rad([0, 45, 80]):
        light = np.array([np.sin(angle), 0, np.cos(angle)])
        reflected = 2 * np.pi * np.mean(model(np.full(len(z), light[2]), z, view @ light) * z) / np.pi
        assert reflected <= light[2] * 1.01


def test_minnaert_of_exponent_one_is_lambert():
    n_l, n_v, _ = _triples()
    assert minnaert(n_l, n_v, 1.0) == pytest.approx(lambert(n_l))


def test_phong_peaks_at_one_in_the_mirror_direction():
    assert phong(np.cos(0.4), np.cos(0.4), np.cos(0.8), 50.0) == pytest.approx(1.0)
    assert phong(np.cos(0.4), np.cos(0.3), np.cos(0.7), 50.0) == pytest.approx(np.cos(0.1) ** 50)


@pytest.mark.parametrize("exponent", [0.1, 2.0, 1e4])
def test_phong_behind_the_mirror_direction_is_dark_whatever_the_exponent(exponent):
    # r.v = 2 * 0.1 * 0.1 - 0.9 < 0: an even power must not turn it into a highlight.
    assert phong(0.1, 0.1, 0.9, exponent) == 0
