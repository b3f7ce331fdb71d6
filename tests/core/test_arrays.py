"""Arrays and meshes that callers give: what fits comes back, what does not is named."""

import numpy as np
import pytest

from scan2albedo.core.arrays import checked_array, checked_mesh


def test_what_fits_comes_back_in_its_kind():
    assert checked_array([[1, 2, 3]], ("N", 3), "points").dtype == np.float64
    assert checked_array(np.int8([1, 2]), (2,), "numbers", kind=int).dtype == np.int64
    assert checked_array([True], ("N",), "mask", kind=bool).dtype == np.bool_
    for given in (np.zeros(3), np.zeros((4, 3)), np.zeros((2, 0, 3))):
        assert checked_array(given, (..., 3), "directions") is given
    given = np.full((2, 3), np.nan)
    assert checked_array(given, (2, 3), "points") is given


@pytest.mark.parametrize(
    ("values", "shape", "kind", "message"),
    [
        (np.zeros((2, 4)), ("N", 3), float, r"x is \(2, 4\), expected \(N, 3\)"),
        (np.zeros(3), ("N", 3), float, r"x is \(3,\), expected \(N, 3\)"),
        (np.zeros((1, 3, 1)), ("N", 3), float, r"x is \(1, 3, 1\), expected \(N, 3\)"),
        (np.zeros((2, 4)), (..., 3), float, r"x is \(2, 4\), expected \(..., 3\)"),
        (np.zeros(()), (..., 3), float, r"x is \(\), expected \(..., 3\)"),
        (np.zeros((2, 3)), (..., "H", "W", 3), float, r"expected \(..., H, W, 3\)"),
        (np.zeros(2), (2,), int, r"x is float64 \(2,\), expected int \(2,\)"),
        (np.zeros(2, int), ("N",), bool, r"x is int64 \(2,\), expected bool \(N,\)"),
        ([0.0, np.inf], ("N",), float, r"x: 1 values are NaN or infinite, first at \[1\]"),
    ],
)
def test_what_does_not_fit_is_named(values, shape, kind, message):
    finite = IndexError if kind is float else None
    with pytest.raises(IndexError if "NaN" in message else TypeError, match=message):
        checked_array(values, shape, "x", TypeError, kind=kind, finite=finite)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.eye(3), [[0.0, 1.0, 1.5]], "not whole"),
        (np.eye(3), [[0, 1, 3]], "refer to vertices 0 to 3 of 3"),
        (np.eye(3), [[0, 1, -1]], "refer to vertices -1 to 1 of 3"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "3 of 3 vertices are NaN"),
        (np.zeros((3, 2)), [[0, 1, 2]], r"its vertices have shape \(3, 2\)"),
    ],
)
def test_faces_are_whole_numbers_of_finite_vertices(vertices, faces, message):
    assert checked_mesh(np.eye(3), [[0.0, 1.0, 2.0]], "it")[1].tolist() == [[0, 1, 2]]
    with pytest.raises(ValueError, match=message):
        checked_mesh(vertices, faces, "it")
