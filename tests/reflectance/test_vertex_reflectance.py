"""Reflectances hold numbers where they are known, and nothing else."""

import numpy as np
import pytest

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import VertexReflectance


def test_what_is_not_known_has_no_number():
    reflectance = VertexReflectance(np.ones((3, 3)), np.zeros((3, 3)), np.array([True, False, True]))
    assert np.isnan(reflectance.diffuse_linear[1]).all()
    assert np.isnan(reflectance.weights[1]).all()
    assert (reflectance.diffuse_linear[[0, 2]] == 1).all()


@pytest.mark.parametrize(
    ("diffuse", "weights", "known", "message"),
    [
        (np.ones((3, 3)), np.ones((2, 3)), np.ones(3, bool), "expected \\(V, 3\\) both"),
        (np.ones((3, 3)), np.ones((3, 3)), np.ones(2, bool), "expected bool"),
        (np.ones((3, 3)), np.ones((3, 3)), np.ones(3), "expected bool"),
        (-np.ones((3, 3)), np.ones((3, 3)), np.ones(3, bool), "vertex 0"),
        (np.ones((3, 3)), np.full((3, 3), np.nan), np.arange(3) == 2, "vertex 2"),
    ],
)
def test_what_does_not_fit_is_refused(diffuse, weights, known, message):
    with pytest.raises(ReflectanceError, match=message):
        VertexReflectance(diffuse, weights, known)
