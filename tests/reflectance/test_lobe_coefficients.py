"""Coefficients of the lobes against published numbers, closed forms and finer quadrature."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.special import eval_legendre

from scan2albedo.lighting.shadow_map import cone_directions
from scan2albedo.reflectance.environment_shading import lambert_coefficients, lobe_coefficients, tilted_lobe


def test_lambert_is_the_clamped_cosine():
    expected = [1, 2 / 3, 1 / 4, 0, -1 / 24, 0, 1 / 64, 0, -1 / 128]
    assert_allclose(lambert_coefficients(), expected, rtol=1e-14, atol=1e-16)
    assert lambert_coefficients(0).tolist() == [1.0]


def integrals(exponent, lowest):
    """Of the lobe along the normal times each Legendre polynomial, from the cosine `lowest` of the light."""

    def integral(degree):
        def lobe(t):
            return (exponent + 2) / 4 * ((1 + t) / 2) ** (exponent / 2) * eval_legendre(degree, t)

        return quad(lobe, lowest, 1, epsabs=1e-12, epsrel=1e-12)[0]

    return [integral(degree) for degree in range(9)]


@pytest.mark.parametrize("exponent", [0.5, 1, 8, 64])
def test_coefficients_are_integrals_of_the_lobe(exponent):
    assert_allclose(lobe_coefficients(exponent), integrals(exponent, -1), atol=1e-10)


@pytest.mark.parametrize("exponent", [0.0, -1.0, np.nan])
@pytest.mark.parametrize("of", [lobe_coefficients, partial(tilted_lobe, 0.5)])
def test_exponents_that_are_none_are_refused(of, exponent):
    with pytest.raises(ValueError, match="exponent"):
        of(exponent)


@pytest.mark.parametrize("angle", np.radians([20, 60, 80]))
@pytest.mark.parametrize("exponent", [1, 8, 64])
def test_tilted_lobes_have_no_light_to_their_side(exponent, angle):
    coefficients, tilt = tilted_lobe([0, angle], exponent)
    assert_allclose(coefficients[0], integrals(exponent, 0), atol=1e-10)
    assert tilt[0] == 0
    light = cone_directions(400_000, (0, 0, 1), np.pi / 2)
    half = light + [np.sin(angle), 0, np.cos(angle)]
    mass = (exponent + 2) / 4 * (half[:, 2] / np.linalg.norm(half, axis=1)) ** exponent / len(light)
    mean = mass @ light
    assert tilt[1] == pytest.approx(np.arctan2(-mean[0], mean[2]), abs=1e-5)
    assert coefficients[1, 0] == pytest.approx(mass.sum(), abs=1e-5)
    assert coefficients[1, 1] == pytest.approx(np.linalg.norm(mean), abs=1e-5)
    assert 0 < tilt[1] < angle


def test_tilted_lobes_of_what_is_not_seen_are_empty():
    assert (tilted_lobe([np.pi / 2, 2.5], 8)[0] == 0).all()
    with pytest.raises(ValueError, match="NaN"):
        tilted_lobe(np.nan, 8)
