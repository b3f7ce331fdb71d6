"""The number of directions that people left out ask for, and the model of synthetic people."""

import numpy as np
import pytest
from build.reflectance_model import PEOPLE, packed
from numpy.testing import assert_allclose

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import reflectance_from_albedo
from scan2albedo.reflectance.morphable_model import held_out_components
from scan2albedo.runs.reflectance.model_run import DEFAULT_MODEL_FILE, default_model, synthetic_model

RNG = np.random.default_rng(0)
VERTICES = RNG.uniform(-100, 100, (800, 3))
DIRECTIONS = RNG.normal(size=(5, 800, 3))


def people(count, noise):
    rng = np.random.default_rng(1)
    offsets = np.tensordot(rng.normal(size=(count, 5)), DIRECTIONS, 1)
    offsets += noise * rng.normal(size=offsets.shape)
    return [reflectance_from_albedo(0.5 + 0.03 * one, weights=[0.02] * 3) for one in offsets]


def test_directions_that_people_share_are_kept_and_noise_is_not():
    assert held_out_components(people(40, noise=1.0), VERTICES) == 5
    assert held_out_components(people(1, noise=1.0) * 10, VERTICES) == 0
    with pytest.raises(ReflectanceError, match="10 or more"):
        held_out_components(people(9, noise=0.1), VERTICES)


def test_a_model_of_synthetic_people_has_reflectance_and_shape():
    built = synthetic_model(3, components=1)
    assert (built.model.samples, built.model.components) == (3, 1)
    assert len(built.shape.mean) == len(built.model.known) == len(built.mean.vertices)
    with pytest.raises(ReflectanceError, match="2 or more"):
        synthetic_model(1)


def test_the_model_of_the_package_is_whole():
    built = default_model()
    assert built.model.samples == 200
    assert built.shape.mean.shape == built.model.diffuse.mean.shape == (3663, 3)
    assert_allclose(built.model.mean[:, 4:].sum(1), 1, rtol=1e-12)
    assert_allclose(built.model.basis[..., 4:].sum(2), 0, atol=1e-12)
    assert built.model.sample(0).clipped_share < 0.05
    assert DEFAULT_MODEL_FILE.stat().st_size < 800_000


@pytest.mark.slow
def test_the_model_of_the_package_is_what_the_command_builds():
    made, built = synthetic_model(PEOPLE), default_model()

    def turned(basis, other):
        """Return components (K, ...) with the signs of others: which one they have is decided by rounding."""
        rows = np.einsum("ki,ki->k", *(np.reshape(b, (len(b), -1)).astype(float) for b in (basis, other)))
        return basis * np.where(rows < 0, -1, 1).reshape(-1, *[1] * (basis.ndim - 1))

    with np.load(DEFAULT_MODEL_FILE) as stored:
        for name, array in packed(made).items():
            if array.dtype == np.int8:  # rounding may fall to either side on other machines
                assert np.abs(turned(array.astype(int), stored[name]) - stored[name]).max() <= 1
            else:
                assert_allclose(stored[name], array, rtol=1e-5, atol=1e-6)
    parts = slice(0, 3), slice(3, 4), slice(4, 7)
    off = [
        np.sqrt(np.mean(np.sum((turned(a, b) - b) ** 2, axis=0)))
        for a, b in (
            *((made.model.basis[..., part], built.model.basis[..., part]) for part in parts),
            (made.shape.basis, built.shape.basis),
        )
    ]
    assert np.all(np.array(off) < [0.002, 1e-4, 1e-3, 0.05])
