"""The number of directions that people left out ask for, and the model of synthetic people."""

import numpy as np
import pytest

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import VertexReflectance
from scan2albedo.reflectance.morphable_model import held_out_components
from scan2albedo.runs.reflectance.model_run import synthetic_model

RNG = np.random.default_rng(0)
VERTICES = RNG.uniform(-100, 100, (800, 3))
DIRECTIONS = RNG.normal(size=(5, 800, 3))


def people(count, noise):
    rng = np.random.default_rng(1)
    offsets = np.tensordot(rng.normal(size=(count, 5)), DIRECTIONS, 1) + noise * rng.normal(
        size=(count, 800, 3)
    )
    diffuse = 0.5 + 0.03 * offsets
    return [VertexReflectance(one, np.full((800, 3), 0.02), np.ones(800, bool)) for one in diffuse]


def test_directions_that_people_share_are_kept_and_noise_is_not():
    assert held_out_components(people(40, noise=1.0), VERTICES) == 5


def test_few_people_do_not_show_how_many():
    with pytest.raises(ReflectanceError, match="10 or more"):
        held_out_components(people(9, noise=0.1), VERTICES)


@pytest.mark.slow
def test_the_model_of_synthetic_people_has_reflectance_and_shape():
    built = synthetic_model(20)
    assert built.model.samples == 20
    assert 0 < built.model.components < 20
    assert built.shape is not None
    assert len(built.shape.mean) == len(built.model.known) == len(built.mean.vertices)
    again = synthetic_model(20, components=built.model.components)
    np.testing.assert_array_equal(again.model.diffuse.basis, built.model.diffuse.basis)
    with pytest.raises(ReflectanceError, match="2 or more"):
        synthetic_model(1)
