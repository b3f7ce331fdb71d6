"""Raw stereo of synthetic people: the statistics that real scans have, and the features asked for."""

import numpy as np
import pytest
from worlds.stereo import FEATURE_LANDMARKS, FEATURES, SCRAPS, StereoScanner, stereo_scan, stereo_scan_of

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.synthetic.sitter import sit_down


def in_model_frame(scan, truth):
    return transform_points(truth.model_from_scan, scan.vertices)


@pytest.mark.slow
def test_scans_have_the_statistics_of_raw_stereo():
    scans = [stereo_scan(seed) for seed in range(8)]
    for scan, truth in scans:
        assert 800 < len(scan.vertices) < 14_000
        assert vertex_components(len(scan.vertices), scan.faces).max() + 1 >= 9
        points = in_model_frame(scan, truth) - truth.landmarks.mean(0)
        away = np.linalg.norm(points, axis=1)
        assert 0.001 < np.mean(away > 200) < 0.3
        assert away.max() < 2000
        corners = points[scan.faces[(away < 150)[scan.faces].all(1)]]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        assert 2.5 < np.median(edges) < 6.5
    assert len({truth.expression for _, truth in scans}) > 2


@pytest.mark.slow
def test_each_feature_changes_what_is_measured():
    """Behind glasses, beside a half face and below a chin nothing is left; mouth, beard, fringe stand off."""
    seen = {name: stereo_scan(5, features=(name,)) for name in FEATURES}
    points = {name: in_model_frame(*pair) for name, pair in seen.items()}
    landmarks = seen["glasses"][1].landmarks

    def near(name, center, radius):
        return points[name][np.linalg.norm(points[name] - center, axis=1) < radius]

    eye, mouth, brow = landmarks[36:42].mean(0), landmarks[48:68].mean(0), landmarks[19]
    assert len(near("glasses", eye, 8)) < len(near("beard", eye, 8))

    def depth_of_the_mouth(name):
        across = np.linalg.norm((points[name] - mouth + [0, 4, 0])[:, :2], axis=1)
        return np.percentile(points[name][across < 10, 2], 20)

    assert depth_of_the_mouth("open mouth") < depth_of_the_mouth("glasses") - 3
    sides = np.sign(near("half face", landmarks[30], 80)[:, 0] - landmarks[30, 0])
    assert abs(sides.mean()) > 0.6
    below = landmarks[8] - [0, 60, 30]
    assert len(near("no neck", below, 25)) < 5 < len(near("glasses", below, 25))
    above = brow + [0, 45, 0]
    assert near("fringe", above, 30)[:, 2].max() > near("glasses", above, 30)[:, 2].max() + 1


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
