"""Holes between lids and lips show where eyes and mouth are; other holes say nothing."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.fits import scan_surface
from numpy.testing import assert_allclose

from scan2albedo import fit
from scan2albedo.fitting.landmark_pull import EYES, INNER_LIPS, openings


def surface_with_holes(model, *holes):
    """Return the model's surface without what lies within half axes (across, up) of points."""
    vertices, faces = model.surface(2)
    centre = vertices[faces].mean(1)
    kept = np.ones(len(faces), bool)
    for middle, across, up in holes:
        inside = (centre - middle)[:, :2] / (across, up)
        kept &= (inside**2).sum(1) > 1
    return scan_surface(vertices, faces[kept])


@pytest.fixture(scope="module")
def middles(model):
    """Right eye, left eye, mouth."""
    return [model.landmarks[list(part)].mean(0) for part in (*EYES, INNER_LIPS)]


def test_a_pair_of_eyes_pulls_lids_to_their_holes(model, middles):
    beside = np.array([3.0, 4.0, 0.0])
    holes = ((eye + beside, 13.0, 5.0) for eye in middles[:2])
    found = openings(surface_with_holes(model, *holes), model)
    assert len(found.targets) == 6
    assert found.still.all()
    assert (found.axes == (1, 1, 0)).all()
    assert_allclose(found.targets[::3, :2], (middles + beside)[:2, :2], atol=1.5)
    right, left, *_ = middles
    corners = model.landmarks[[36, 39, 42, 45]]
    points = [right, *corners[:2], left, *corners[2:]]
    assert_allclose(found.matrix @ model.control_vertices, points, atol=1e-6)
    across = found.targets[:, 0].reshape(2, 3)
    assert_allclose(across - across[:, :1], [[0, -13, 13]] * 2, atol=2.0)


def test_a_mouth_shows_no_depth_and_does_not_move_the_pose(model, middles):
    found = openings(surface_with_holes(model, (middles[2] - [0, 6, 0], 20.0, 9.0)), model)
    assert len(found.targets) == 3
    assert not found.still.any()
    assert (found.axes == (1, 1, 0)).all()
    assert found.targets[0, 1] == pytest.approx(middles[2][1] - 6, abs=1.5)


def test_other_holes_say_nothing(model, middles):
    right, left, mouth = middles
    assert openings(surface_with_holes(model), model) is None
    eye = right, 13.0, 5.0
    for holes in (
        [eye],
        [eye, (left + [0, 9, 0], 13.0, 5.0)],  # one far higher
        [eye, (left, 3.0, 3.0)],  # one far smaller
        [eye, (left, 13.0, 10.0)],  # more than an eye is missing
        [(right, 25.0, 16.0), (left, 25.0, 16.0)],  # the strips that glasses leave
        [(mouth + [14, 0, 0], 14.0, 8.0)],  # a corner of the mouth
        [(mouth, 5.0, 5.0)],
    ):
        assert openings(surface_with_holes(model, *holes), model) is None, holes
    eyes = surface_with_holes(model, eye, (left, 13.0, 5.0))
    assert openings(eyes, replace(model, landmark_points=None)) is None


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "ceiling_mm"), [("person3", 4.2), ("person4", 4.0)])
def test_eyes_of_measured_faces_are_nearer(ict, model, shape, ceiling_mm):
    # Without their holes 5.5 and 5.1 mm.
    scan, pose, errors_mm = ict.scan_of(shape, model, 3, slice(17, 48))
    assert errors_mm(fit(scan, model, pose))[36:48].mean() < ceiling_mm
