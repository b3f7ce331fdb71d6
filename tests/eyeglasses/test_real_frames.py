"""Two real frames, as they come: 26 parts with open rims, and a printed front; key points by a rule."""

import numpy as np
import pytest
from helpers.measures import rms, row_lengths

from scan2albedo.eyeglasses import bounded_biharmonic_weights, solve_weights
from scan2albedo.io import load_scan

pytestmark = pytest.mark.slow

FRAMES = {"sunglasses_khronos.glb": 3.0, "frame_giraut.stl": 2.0}
"""Files and lattice spacings in mm, coarse enough for a quick test."""


@pytest.mark.parametrize(("file", "spacing"), FRAMES.items())
def test_weights_meet_the_bars_and_bend_the_frame_as_on_a_coarser_lattice(shared_data, file, spacing):
    scan = load_scan(shared_data / file)
    # Farthest points, from the leftmost vertex on: 20 key points spread over the frame.
    chosen = [int(np.argmin(scan.vertices[:, 0]))]
    distance = np.inf
    while len(chosen) < 20:
        distance = np.minimum(distance, row_lengths(scan.vertices - scan.vertices[chosen[-1]]))
        chosen.append(int(np.argmax(distance)))
    points = scan.vertices[chosen]
    found = solve_weights(scan.vertices, scan.faces, points, spacing)
    assert found.converged
    assert found.residual.max() <= 1e-6
    assert np.abs(found.weights.sum(1) - 1).max() <= 1e-12
    assert found.weights.min() >= 0
    np.testing.assert_allclose(found.weights[chosen], np.eye(20), atol=1e-15)
    # The ends 6 mm outward and 3 mm down, as a wearer bends them.
    side = (points - (points.min(0) + points.max(0)) / 2) / np.ptp(points, axis=0)
    shift = np.stack([6 * side[:, 0] * side[:, 2], -3 * np.abs(side[:, 0]), np.zeros(20)], 1)
    coarser = bounded_biharmonic_weights(scan.vertices, scan.faces, points, 1.2 * spacing)
    apart = row_lengths((coarser - found.weights) @ shift)
    assert apart.max() < 0.3
    assert rms(apart) < 0.1
