"""Raw stereo of synthetic people: the statistics that real scans have, and the features asked for."""

import numpy as np
import pytest

from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.synthetic import StereoScanOptions, stereo_scan
from scan2albedo.synthetic.stereo_scan import FEATURES

PLAIN = StereoScanOptions(features=())


@pytest.fixture(scope="module")
def scans():
    return [stereo_scan(seed) for seed in range(8)]


def in_model_frame(scan, truth):
    return transform_points(truth.model_from_scan, scan.vertices)


def test_scans_have_the_statistics_of_raw_stereo(scans):
    for scan, truth in scans:
        assert 800 < len(scan.vertices) < 14_000
        assert vertex_components(len(scan.vertices), scan.faces).max() + 1 >= 9
        away = np.linalg.norm(in_model_frame(scan, truth) - truth.landmarks.mean(0), axis=1)
        assert 0.001 < np.mean(away > 200) < 0.3
        assert away.max() < 2000
        near = in_model_frame(scan, truth)[scan.faces]
        kept = (np.linalg.norm(near - truth.landmarks.mean(0), axis=2) < 150).all(1)
        edges = np.linalg.norm(near[kept] - np.roll(near[kept], 1, axis=1), axis=2)
        assert 2.5 < np.median(edges) < 6.5
    assert len({truth.expression for _, truth in scans}) > 2


def test_landmarks_lie_on_the_scan_in_the_truths_frame():
    scan, truth = stereo_scan(3, options=PLAIN)
    points = in_model_frame(scan, truth)
    apart = np.linalg.norm(points[:, None] - truth.landmarks[None, 17:], axis=2).min(0)
    assert np.median(apart) < 4


def test_the_same_seed_gives_the_same_scan_and_another_another():
    first, again, other = (stereo_scan(seed, options=PLAIN)[0] for seed in (1, 1, 2))
    assert np.array_equal(first.vertices, again.vertices)
    assert len(first.vertices) != len(other.vertices)


def _across(points, center):
    return np.linalg.norm((points - center)[:, :2], axis=1)


def test_each_feature_changes_what_is_measured():
    """Behind glasses, beside a half face and below a chin nothing is left; mouth, beard, fringe stand off."""
    options = {name: StereoScanOptions(features=(name,)) for name in FEATURES}
    seen = {name: stereo_scan(5, options=option) for name, option in options.items()}
    points = {name: in_model_frame(*pair) for name, pair in seen.items()}
    landmarks = seen["glasses"][1].landmarks

    def near(name, center, radius):
        return points[name][np.linalg.norm(points[name] - center, axis=1) < radius]

    eye, mouth, brow = landmarks[36:42].mean(0), landmarks[48:68].mean(0), landmarks[19]
    assert len(near("glasses", eye, 8)) < len(near("beard", eye, 8))
    depth = {name: points[name][_across(points[name], mouth - [0, 4, 0]) < 10, 2] for name in FEATURES}
    assert np.percentile(depth["open mouth"], 20) < np.percentile(depth["glasses"], 20) - 3
    sides = np.sign(near("half face", landmarks[30], 80)[:, 0] - landmarks[30, 0])
    assert abs(sides.mean()) > 0.6
    below = landmarks[8] - [0, 60, 30]
    assert len(near("no neck", below, 25)) < 5 < len(near("glasses", below, 25))
    above = brow + [0, 45, 0]
    assert near("fringe", above, 30)[:, 2].max() > near("glasses", above, 30)[:, 2].max() + 1
    with pytest.raises(ValueError, match="unknown features"):
        stereo_scan(0, options=StereoScanOptions(features=("moustache",)))
