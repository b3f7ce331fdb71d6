"""Widths and units of frames, and frames unlike the others of a set."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.mean_keypoints import (
    WIDTHS_MM,
    front_width,
    outliers,
    single_bridges,
    unit_exponent,
    unit_factors,
)
from scan2albedo.synthetic import GlassesBend, eyeglasses


def test_the_width_is_that_of_the_front_whatever_the_temples():
    wide = eyeglasses(0, bend=GlassesBend(temple_spread_mm=40)).keypoints
    points = eyeglasses(0).keypoints
    hinges = np.linalg.norm(points[7] - points[16])
    assert front_width(points) == pytest.approx(hinges)
    assert front_width(wide) == pytest.approx(hinges, abs=0.5)
    points[[6, 7]] = np.nan
    assert np.isnan(front_width(points))


def test_with_a_mesh_the_width_is_that_of_the_front_itself():
    frame = eyeglasses(0, bend=GlassesBend(temple_spread_mm=4))
    front = frame.vertices[frame.vertices[:, 2] > frame.keypoints[7, 2] - 8]
    stray = np.vstack([frame.vertices, [[500.0, 0, 0]]])
    width = front_width(frame.keypoints, stray)
    assert width == pytest.approx(np.ptp(front[:, 0]), abs=1.5)
    assert width > front_width(frame.keypoints) + 3
    # Wide enough though its key points are not.
    points, vertices = 0.78 * frame.keypoints, 0.78 * frame.vertices
    assert front_width(points) < 110
    assert unit_exponent(points, WIDTHS_MM, front_width(points, vertices)) == 0


def widths_of(points):
    return np.array([front_width(one) for one in points])


@pytest.mark.parametrize(("factor", "exponent"), [(1, 0), (0.1, 1), (1e-3, 3), (1e-6, 6), (1e3, -3)])
def test_the_width_tells_the_unit(factor, exponent):
    points = eyeglasses(0).keypoints
    assert unit_exponent(factor * points, WIDTHS_MM) == exponent
    points[[7, 16, 6, 15]] = np.nan  # no width: the bones tell it
    assert unit_exponent(factor * points, WIDTHS_MM) == exponent


def test_frames_of_one_unit_stay_in_it():
    assert_array_equal(unit_factors([3, 3], None), [1, 1])
    assert_array_equal(unit_factors([3, 1, 0], None), [1000, 10, 1])
    assert_array_equal(unit_factors([0, -3], 3), [1e-3, 1e-6])


def test_no_width_of_spectacles_is_refused():
    points = eyeglasses(0).keypoints
    for factor in (0.5, 1.6, 0.02):
        with pytest.raises(EyeglassesError, match=r"its front is .* units wide.*--widths"):
            unit_exponent(factor * points, WIDTHS_MM)
    assert unit_exponent(0.5 * points, (50.0, 170.0)) == 0


def test_outliers_are_found_beside_bent_frames():
    bends = np.random.default_rng(0).uniform([-6, 0, -3], [8, 0, 5], (10, 3))
    points = [eyeglasses(seed, bend=GlassesBend(*bend)).keypoints for seed, bend in enumerate(bends)]
    assert outliers(points, widths_of(points)) == {}
    points[3][[3, 5]] = points[3][[5, 3]]
    points[6] *= 1.4
    found = outliers(points, widths_of(points))
    assert sorted(found) == [3, 6]
    assert "the farthest is left_rim_" in found[3]
    assert "its front is" in found[6]
    assert outliers(points[3:6], widths_of(points[3:6])) == {}


def test_single_bridges_are_named_where_others_have_two():
    single, double = eyeglasses(0).keypoints, eyeglasses(1, double_bridge=True).keypoints
    bare = np.where(np.arange(20)[:, None] == 0, np.nan, single)
    for points, mean, expected in (
        ([single, double, single], None, (0, 2)),
        ([bare, double], None, ()),
        ([single, single], None, ()),
        ([single, bare], double, (0,)),
    ):
        assert single_bridges(points, widths_of(points), mean) == expected
