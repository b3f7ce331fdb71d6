"""How sure the shaped template makes one: of faces, and of nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.meshes import grid, sphere
from helpers.poses import moved

from scan2albedo import RawScan
from scan2albedo.core import Meter
from scan2albedo.geometry.rigid import Similarity, compose, invert_rigid
from scan2albedo.registration.evidence import evidence
from scan2albedo.registration.inputs import RegistrationOptions, Template, prepared_scan


def evidence_at(scan, template, scan_from_model=np.eye(4)):
    """What a scan says of a pose, that of its own frame when none is given."""
    prepared = prepared_scan(scan, RegistrationOptions())
    pose = prepared.prepared_from_scan @ scan_from_model
    return evidence(prepared, template, Similarity(pose[:3, :3], pose[:3, 3]), Meter("icp", "mm"))


def test_a_face_is_beyond_doubt(upright, template):
    found = evidence_at(upright, template)
    assert found.log_odds > 4
    assert found.share > 0.8
    assert found.rms_mm < 1.5


def test_relief_says_as_much_as_there_is_face_that_shows_it(upright, template):
    """Shared by a scrap it may be chance; shared exactly, it does not outweigh all else."""
    found = evidence_at(upright, template)
    scrap = replace(found, relief=replace(found.relief, coverage=found.relief.coverage / 4))
    assert scrap.cues["relief"] == pytest.approx(found.cues["relief"] / 4)
    exact, opposite = (replace(found, relief=replace(found.relief, whole=r)) for r in (1.0, -1.0))
    assert found.cues["relief"] <= exact.cues["relief"] < 5
    assert opposite.cues["relief"] == 0


def test_a_ball_and_a_face_upside_down_are_no_faces(upright, template):
    assert evidence_at(RawScan(*sphere(5, 95.0)), template).log_odds < -3
    turned = replace(upright, vertices=upright.vertices * [-1, -1, 1])
    assert evidence_at(turned, template).log_odds < -1


def test_no_scan_near_the_template_is_no_face_and_all_finite(template):
    sheet, faces = grid(21, 21)
    found = evidence_at(RawScan(200 * sheet, faces), template, compose(np.eye(3), [5000.0, 0, 0]))
    assert np.isfinite(list(found.cues.values())).all()
    assert found.log_odds < -8


def test_the_template_is_kept_as_long_as_its_model(model):
    assert Template.of(model, 0) is Template.of(model, 0)
    assert Template.of(model, 0) is not Template.of(model, 1)


def test_the_frame_of_the_scan_does_not_matter(upright, template):
    one = evidence_at(upright, template)
    pose = invert_rigid(np.array([[0, -1, 0, 50], [1, 0, 0, -20], [0, 0, 1, 300], [0, 0, 0, 1.0]]))
    other = evidence_at(moved(upright, pose), template, pose)
    assert other.log_odds == pytest.approx(one.log_odds, abs=0.2)
