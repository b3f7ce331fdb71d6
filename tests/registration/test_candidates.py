"""Starting poses reach every part of a scan; colours decide where shape does not."""

import builtins

import numpy as np
import pytest
from helpers.meshes import sphere
from helpers.poses import REST

from scan2albedo import RawScan
from scan2albedo.errors import MissingDependencyError, NoFaceError, import_open3d
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.oriented_points import anchors, oriented_points
from scan2albedo.geometry.rigid import (
    Similarity,
    invert_rigid,
)
from scan2albedo.registration import register
from scan2albedo.registration.candidates import Candidate, rescored
from scan2albedo.registration.coarse_search import anchored_starts
from scan2albedo.registration.evidence import Evidence, colour_scorer
from scan2albedo.registration.inputs import RegistrationOptions, prepared_scan
from scan2albedo.registration.relief import ReliefAgreement


@pytest.mark.parametrize(
    "error", [ImportError("libusb-1.0.so.0: cannot open"), OSError("libGL.so.1: cannot open shared object")]
)
def test_a_missing_system_library_is_one_line_with_the_command(monkeypatch, error):
    real_import = builtins.__import__

    def broken(name, *rest):
        if name == "open3d":
            raise error
        return real_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", broken)
    with pytest.raises(MissingDependencyError) as caught:
        import_open3d()
    message = str(caught.value)
    for told in ("tools/bootstrap_system.sh", "libgl1", str(error)):
        assert told in message
    assert "\n" not in message


def looked_at(pose, relief):
    agreement = ReliefAgreement(1.0, relief, relief)
    return Candidate(pose, agreement, 1.0, Evidence(pose, np.zeros(65), 1.0, 1.0, agreement))


def test_colours_are_asked_only_in_doubt_and_then_tell_upside_down_from_upright(coarse_scan, model):
    scan, known = coarse_scan
    prepared = prepared_scan(scan, RegistrationOptions())
    colors = prepared, model.front, lambda: colour_scorer(scan, model)
    truth = prepared.prepared_from_scan @ invert_rigid(known.model_from_scan)
    upright = Similarity(truth[:3, :3], truth[:3, 3])
    flipped = Similarity(truth[:3, :3] @ np.diag([-1.0, -1.0, 1.0]), truth[:3, 3])
    sure = (looked_at(flipped, 0.9), looked_at(upright, 0.3))
    assert rescored(sure, *colors) is sure
    doubtful = (looked_at(flipped, 0.3), looked_at(upright, 0.3))
    best, other = rescored(doubtful, *colors)
    assert best.pose is upright
    assert best.color_log_odds > 1
    assert other.color_log_odds < 0


def test_a_scan_without_colours_says_nothing(synthetic_scan, model):
    scan = synthetic_scan(3).scan
    bare = prepared_scan(RawScan(scan.vertices, scan.faces), RegistrationOptions())
    doubtful = (looked_at(REST, 0.3),)
    assert rescored(doubtful, bare, model.front, lambda: colour_scorer(bare.raw, model)) is doubtful


def test_a_sphere_is_refused_after_all_rounds(model):
    with pytest.raises(NoFaceError, match=r"The best of [23]\d poses is one with a probability of 0\.00"):
        register(RawScan(*sphere(4, 100.0)), model)


def test_starts_on_a_sphere_face_outward_everywhere():
    samples = oriented_points(*sphere(4), 5.0)
    spread = anchors(samples, spacing=30.0, limit=600, reach=45.0)
    front = np.array([1.0, 2.0, 40.0])
    starts = anchored_starts(spread, front, 300)
    on_surface = np.einsum("nij,j->ni", starts.rotations, front) + starts.translations
    outward = normalized(on_surface)
    cosine = np.einsum("ni,ni->n", outward, starts.rotations[:, :, 2])
    assert np.degrees(np.arccos(cosine.min())) < 36.5
    directions = normalized(np.random.default_rng(0).normal(size=(200, 3)))
    assert np.degrees(np.arccos((directions @ outward.T).max(1).min())) < 25
    # Every anchor is tried at several roll angles.
    assert len(starts) > 10 * len(np.unique(on_surface.round(3), axis=0))
