"""The distortion of charts whose maps are known."""

import numpy as np
from helpers.chart_distortion import chart_distortion
from helpers.meshes import grid


def test_distortion_of_known_maps():
    v, f = grid(3, 3)
    v = 2 * v - [1, 1, 0]
    isometric = chart_distortion(v, f, v[:, :2])
    np.testing.assert_allclose([isometric.area, isometric.conformal, isometric.coverage], [0, 1, 4])
    stretched = chart_distortion(v, f, v[:, :2] * [3.0, 1.0])
    np.testing.assert_allclose([stretched.area, stretched.conformal], [0, 3], atol=1e-12)
    assert chart_distortion(v, f, v[:, :2] * [-1.0, 1.0]).flipped == len(f)
