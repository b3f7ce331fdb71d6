"""Landmarks that someone placed are checked where they enter."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scan2albedo.core.landmarks import PLACED_SIGMA_MM, PlacedLandmarks
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import ScanError

TRIANGLE = ([[0, 0, 0], [100, 0, 0], [0, 100, 0]], [[0, 1, 2]])


def some(number, point):
    points = np.full((68, 3), np.nan)
    points[number] = point
    return points


def test_a_mapping_and_an_array_are_the_same():
    of_mapping = PlacedLandmarks.of({30: (1, 2, 3), np.int64(8): [4.0, 5.0, 6.0]}, mm_per_unit=10)
    points = some(30, (1, 2, 3))
    points[8] = 4, 5, 6
    of_array = PlacedLandmarks.of(points, mm_per_unit=10)
    assert_array_equal(of_mapping.points, of_array.points)
    assert_array_equal(of_mapping.points[30], (10, 20, 30))
    assert np.flatnonzero(of_mapping.placed).tolist() == [8, 30]
    assert (of_mapping.sigma_mm == PLACED_SIGMA_MM).all()


def test_they_grow_with_their_scan():
    scan = RawScan(*TRIANGLE, landmarks={30: (1, 2, 3)}).scaled(10.0)
    assert_array_equal(scan.landmarks.points[30], (10, 20, 30))
    assert_array_equal(scan.vertices[1], (1000, 0, 0))
    assert scan.mm_per_unit == 10.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({68: (0, 0, 0)}, "unknown landmark 68"),
        ({"36": (0, 0, 0)}, "unknown landmark '36'"),
        ({36: (0, 0)}, "landmark 36 is .* expected three"),
        ({36: "abc"}, "landmark 36 is 'abc'"),
        ({}, "no landmark among"),
        (some(36, (np.inf, 0, 0)), "landmark 36 is .*inf"),
        (some(36, (1e200, 0, 0)), "landmark 36 is .*1e.200"),
        (some(36, (np.nan, 0, 0)), "landmark 36 is .*nan"),
        (np.zeros((5, 3)), r"shape \(5, 3\)"),
        ([[1, 2], [3]], r"not a \(68, 3\) array"),
    ],
)
def test_what_is_no_landmark_is_named(given, message):
    with pytest.raises(ScanError, match=message):
        PlacedLandmarks.of(given)


def test_other_objects_are_a_type_error():
    with pytest.raises(TypeError, match=r"of type int, expected a file"):
        PlacedLandmarks.of(5)
