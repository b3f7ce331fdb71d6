"""Reflectance of a population's people, straight from the generator."""

import numpy as np

import scan2albedo as s2a
from scan2albedo.synthetic import population_reflectance
from scan2albedo.synthetic.sitter import sit_down


def test_people_correspond_and_differ():
    one, two = (population_reflectance(k) for k in range(2))
    assert one.diffuse_linear.shape == one.weights.shape == (3663, 3)
    np.testing.assert_array_equal(one.faces, two.faces)
    assert (one.weights > 0).all()
    assert np.abs(np.log(one.diffuse_linear / two.diffuse_linear)).mean() > 0.1
    assert np.linalg.norm(one.vertices - two.vertices, axis=1).mean() > 0.5
    np.testing.assert_array_equal(population_reflectance(1).diffuse_linear, two.diffuse_linear)


def test_the_shape_is_that_of_the_sitter():
    model = s2a.AnnotatedFaceModel.default()
    own = np.random.default_rng([0, 3, 11])
    sitter = sit_down(int(own.integers(2**31)), expression="neutral", model=model)
    found = population_reflectance(3)
    np.testing.assert_allclose(found.vertices, model.subdivision(1).matrix @ sitter.control_points)
