"""Reflectances hold numbers where they are known; a Phong lobe becomes three."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import (
    EXPONENTS,
    VertexReflectance,
    lobe_weights_of_phong,
    reflectance_from_albedo,
)

ONES = np.ones((3, 3))


def test_what_is_not_known_has_no_number():
    reflectance = VertexReflectance(np.ones((2, 3)), np.zeros((2, 3)), np.array([True, False]))
    assert_array_equal(reflectance.diffuse_linear, [[1] * 3, [np.nan] * 3])
    assert_array_equal(reflectance.weights, [[0] * 3, [np.nan] * 3])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": ONES[:2]}, r"weights is \(2, 3\), expected \(3, 3\)"),
        ({"known": np.ones(2, bool)}, "expected bool"),
        ({"known": np.ones(3)}, "expected bool"),
        ({"diffuse_linear": -ONES}, "vertex 0"),
        ({"weights": ONES * np.nan, "known": np.arange(3) == 2}, "vertex 2"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    given = {"diffuse_linear": ONES, "weights": ONES, "known": np.ones(3, bool)}
    with pytest.raises(ReflectanceError, match=message):
        VertexReflectance(**{**given, **changes})


@pytest.mark.parametrize("exponent", [2.0, 6.0, 16.0])
def test_three_lobes_come_close_to_a_highlight(exponent):
    weights = lobe_weights_of_phong(0.3, exponent)
    angle = np.linspace(0, np.pi / 4, 100)
    lobes = sum(w * (s + 2) / 8 * np.cos(angle) ** s for w, s in zip(weights, EXPONENTS, strict=True))
    highlight, area = 0.3 * np.cos(2 * angle) ** exponent, np.sin(angle)
    assert area @ (lobes - highlight) ** 2 < 0.25**2 * (area @ highlight**2)
    assert (weights >= 0).all()


def test_one_set_of_weights_serves_all_known_vertices():
    albedo = np.full((4, 3), 0.5)
    albedo[1, 2] = np.nan
    reflectance = reflectance_from_albedo(albedo, weights=[0.1, 0.2, 0.3])
    assert reflectance.known.tolist() == [True, False, True, True]
    assert_array_equal(reflectance.weights[3], [0.1, 0.2, 0.3])
    fewer = reflectance_from_albedo(albedo, known=np.arange(4) == 2)
    assert fewer.known.sum() == 1


@pytest.mark.parametrize(
    ("albedo", "options", "message"),
    [
        (np.ones(3), {}, "albedo_linear"),
        (np.ones((2, 3)), {"weights": np.ones((3, 3))}, "weights"),
        (np.full((2, 3), np.nan), {"known": np.ones(2, bool)}, "vertex 0"),
    ],
)
def test_what_is_no_albedo_is_refused(albedo, options, message):
    with pytest.raises(ReflectanceError, match=message):
        reflectance_from_albedo(albedo, **options)


@pytest.mark.parametrize(("strength", "exponent"), [(-1, 8), (np.nan, 8), (1, 0), (1, np.inf)])
def test_what_is_no_highlight_is_refused(strength, exponent):
    with pytest.raises(ReflectanceError, match="highlight"):
        lobe_weights_of_phong(strength, exponent)
