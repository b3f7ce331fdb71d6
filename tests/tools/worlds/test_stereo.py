"""Raw stereo of synthetic people: the statistics that real scans have, and the features asked for."""

import numpy as np
import pytest
from worlds.stereo import FEATURE_LANDMARKS, SCRAPS, StereoScanner, stereo_scan, stereo_scan_of

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.synthetic.sitter import sit_down


def in_model_frame(scan, truth):
    return transform_points(truth.model_from_scan, scan.vertices)


def _nearest(points, others):
    return np.linalg.norm(points[:, None] - others[None], axis=2).min(1)


def test_captures_of_one_shape_share_the_person_and_nothing_else():
    how = {"features": ("open mouth",), "scanner": StereoScanner(noise_mm=(0.1, 0.1))}
    pairs = [stereo_scan(6, capture_seed=capture, **how) for capture in (0, 1)]
    (first, truth), (second, other) = pairs
    assert np.array_equal(truth.landmarks, other.landmarks)
    assert (truth.expression, truth.features) == (other.expression, other.features)
    assert not np.allclose(truth.model_from_scan, other.model_from_scan)
    assert len(first.vertices) != len(second.vertices)
    eyes, mouth = truth.landmarks[36:48].mean(0), truth.landmarks[48:].mean(0)
    for center in (eyes, mouth):
        points, others = (in_model_frame(*pair) for pair in pairs)
        near = points[np.linalg.norm(points - center, axis=1) < 20]
        assert np.median(ClosestPointQuery(others, second.faces).query(near).distance) < 0.3
    again, _ = stereo_scan(6, capture_seed=1, **how)
    assert np.array_equal(again.vertices, second.vertices)


def test_any_head_can_be_scanned_wherever_it_is(model):
    sitter, shift = sit_down(6, expression="smile", model=model), np.array([400.0, -900.0, 250.0])
    landmarks = sitter.face.landmarks + shift
    plain, before = stereo_scan_of(sitter.vertices + shift, sitter.faces, landmarks, 2, features=())
    assert np.array_equal(before.landmarks, landmarks)
    assert (before.expression, before.features) == ("", ())
    assert np.median(_nearest(landmarks[17:], in_model_frame(plain, before))) < 4
    features = ("fringe", "glasses")
    worn, truth = stereo_scan_of(sitter.vertices + shift, sitter.faces, landmarks, 2, features=features)
    eye = landmarks[[37, 38, 40, 41]].mean(0)[None]
    assert _nearest(eye, in_model_frame(worn, truth)) > 6 > _nearest(eye, in_model_frame(plain, before))


@pytest.mark.parametrize("scrap", SCRAPS)
def test_a_scrap_shows_no_face(scrap):
    scan, truth = stereo_scan(SCRAPS.index(scrap), features=(), scrap=scrap)
    piece = vertex_components(len(scan.vertices), scan.faces)[scan.faces[:, 0]]
    largest = np.unique(scan.faces[piece == np.bincount(piece).argmax()])
    assert len(largest) > 50
    shown = _nearest(truth.landmarks[FEATURE_LANDMARKS], in_model_frame(scan, truth)[largest]) < 8
    assert shown.mean() < 0.2


def test_holes_that_leave_nothing_are_named():
    with pytest.raises(ValueError, match="nothing is left of the head: fewer holes"):
        stereo_scan(0, scanner=StereoScanner(reach_mm=(20.0, 20.0), holes=(600, 600)))
