"""What is known at the nodes: precision and determinant for any scales, and what cells and factors give."""

import numpy as np
import pytest
from helpers.lit_scenes import direction, lit_scene, shaded_image
from scipy.linalg import cho_factor

from scan2albedo.albedo.node_field import Scales, cell_variances, inverse, posterior_factor, solved
from scan2albedo.albedo.prior import AlbedoPrior


@pytest.fixture(scope="module", params=["stationary", "faces"])
def posterior(request):
    image = lit_scene((60, 0, 8.0)).image
    return shaded_image(image, prior=getattr(AlbedoPrior, request.param)()).posterior(24)


@pytest.fixture(scope="module")
def field(posterior):
    return posterior.field


@pytest.mark.parametrize(
    "scales", [Scales(), Scales(0.3, 2.0), Scales(1.7, 0.2, grain=3.0), Scales(0.8, 1e-3)]
)
def test_precision_is_the_inverse_of_both_covariances_in_their_scales(field, scales):
    covariance = scales.albedo**2 * field.albedo_covariance + scales.light**2 * field.light_covariance
    assert covariance @ field.precision(scales) == pytest.approx(np.eye(len(covariance)), abs=1e-5)
    assert field.log_determinant(scales) == pytest.approx(np.linalg.slogdet(covariance)[1])


def test_the_precision_that_is_kept_is_that_of_the_scales_asked_for(field):
    first = field.precision(Scales(0.5)).copy()
    other = field.precision(Scales(0.5, 2.0))
    assert np.abs(other - first).max() > 0.01 * np.abs(first).max()
    assert np.array_equal(field.precision(Scales(0.5, grain=2.0, soft=3.0)), first)


def test_light_that_no_part_stands_for_is_less_known_where_it_is_dark(posterior):
    """It is a part of the median light, whatever lies on it."""
    nodes = posterior.nodes
    light = posterior.field.light_covariance
    deviation = np.sqrt(cell_variances(nodes, light))
    cosine = posterior.level.normal @ direction(60)
    assert deviation[cosine < -0.1].mean() > 2.5 * deviation[cosine > 0.3].mean()
    # Of the median light it is 6 %, and some neighbours of a node are darker.
    assert 0.015 < deviation[cosine > 0.3].mean() < 0.06


def test_variances_of_cells_are_those_of_the_dense_product(posterior):
    nodes, covariance = posterior.nodes, posterior.field.albedo_covariance
    dense = nodes.toarray()
    found = cell_variances(nodes, covariance)
    assert found == pytest.approx(np.diag(dense @ covariance @ dense.T))


def test_a_factor_is_that_of_the_precision_with_the_cells(posterior):
    rng, dense = np.random.default_rng(0), posterior.nodes.toarray()
    weight, precision = rng.uniform(0.1, 5, len(dense)), posterior.field.precision(Scales())
    before = precision.copy()
    factor = posterior_factor(posterior.nodes, weight, precision)
    assert np.array_equal(precision, before)
    whole = precision + dense.T @ (weight[:, None] * dense)
    values = rng.normal(size=(len(whole), 2))
    assert whole @ solved(factor, values) == pytest.approx(values, abs=1e-6)


def test_inverse_is_symmetric_and_that_of_the_matrix_with_this_factor():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(30, 30))
    matrix = root @ root.T + np.eye(30)
    found = inverse(cho_factor(matrix, lower=True)[0])
    assert np.array_equal(found, found.T)
    assert found @ matrix == pytest.approx(np.eye(30), abs=1e-9)


def test_weights_leave_out_nodes_that_no_cell_of_the_level_touches(posterior):
    """A hemisphere fills a disc of the chart."""
    field = posterior.field
    assert len(field.used) < posterior.prior.node_weights(posterior.places).shape[1]
    assert (np.diff(field.used) > 0).all()
    ours, whole = posterior.nodes, posterior.prior.node_weights(posterior.places)
    np.testing.assert_allclose(ours.sum(1), whole.sum(1), atol=0.02)
