"""Values at vertices that have none come from around them."""

import numpy as np
import pytest
from helpers.meshes import grid

from scan2albedo.geometry.operators import filled_over_mesh


def test_a_linear_field_is_continued_exactly():
    _, faces = grid(9, 9)
    row, column = np.divmod(np.arange(81), 9)
    values = np.stack([2.0 * row - column, 0.5 * column], 1)
    hole = (abs(row - 4) < 3) & (abs(column - 4) < 3)
    filled = filled_over_mesh(np.where(hole[:, None], np.nan, values), ~hole, faces)
    np.testing.assert_allclose(filled, values, atol=1e-9)


def test_a_part_without_any_value_gets_the_mean():
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    known = np.array([True, True, False, False, False, False])
    filled = filled_over_mesh(np.array([[1.0], [3], [9], [9], [9], [9]]), known, faces)
    np.testing.assert_allclose(filled.ravel(), [1, 3, 2, 2, 2, 2])
    with pytest.raises(ValueError, match="no vertex is known"):
        filled_over_mesh(np.ones((6, 1)), np.zeros(6, bool), faces)
