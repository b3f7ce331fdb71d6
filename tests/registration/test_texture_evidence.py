"""What colours say of a pose: for the right one, against it upside down, nothing where they show nothing."""

from dataclasses import fields, replace

import numpy as np
import pytest

from scan2albedo.geometry.rigid import compose, rotation_from_vector
from scan2albedo.registration.texture_evidence import ColourScorer, TextureEvidence, texture_evidence
from scan2albedo.synthetic import Scanner, raw_scan

SCORES = [field.name for field in fields(TextureEvidence) if field.name != "log_odds"]
UPSIDE_DOWN = compose(rotation_from_vector([0, 0, np.pi]), np.zeros(3))


@pytest.fixture(scope="module", params=range(4))
def case(request, model):
    """A coloured scan, its right pose, and what its colours say."""
    scanner = Scanner(size=32, picture_size=300, spacing_mm=4.0)
    scan, truth = raw_scan(request.param, scanner=scanner)
    return scan, truth.model_from_scan, ColourScorer.of(scan, model)


def assert_alike(one, other, tolerance):
    for name in SCORES:
        assert getattr(one, name) == pytest.approx(getattr(other, name), abs=tolerance), name


def test_the_right_pose_is_likely_and_others_are_not(case):
    _, pose, witness = case
    right = witness.evidence(pose)
    assert right.log_odds > 0.5
    assert all(-1 <= getattr(right, name) <= 1 for name in SCORES)
    assert witness.evidence(UPSIDE_DOWN @ pose).log_odds < -0.5
    for shift in ([0, 20, 0], [0, -20, 0]):
        shifted = witness.evidence(compose(np.eye(3), shift) @ pose)
        assert shifted.lips < right.lips - 0.1
        assert shifted.log_odds <= right.log_odds


def test_the_strength_of_the_light_does_not_matter(case, model):
    scan, pose, witness = case
    dark = replace(scan, texture_linear=scan.texture_linear * 0.1)
    assert_alike(texture_evidence(dark, model, pose), witness.evidence(pose), 1e-3)


def test_colours_of_vertices_say_the_same(case, model):
    scan, pose, witness = case
    corners = scan.uv.reshape(-1, 2) % 1
    height, width = scan.texture_linear.shape[:2]
    place = ((1 - corners[:, 1]) * height).astype(int), (corners[:, 0] * width).astype(int)
    color = np.zeros((len(scan.vertices), 3), np.float32)
    color[scan.faces.ravel()] = scan.texture_linear[place]
    plain = replace(scan, uv=None, texture_linear=None, vertex_color_linear=color)
    found = texture_evidence(plain, model, pose)
    assert_alike(found, witness.evidence(pose), 0.35)
    assert found.log_odds > 0


def test_neither_winding_nor_fine_triangles_matter(case, model, monkeypatch):
    scan, pose, witness = case
    assert_alike(texture_evidence(scan.inside_out(), model, pose), witness.evidence(pose), 0.1)
    monkeypatch.setattr("scan2albedo.registration.texture_evidence._MOST_FACES", len(scan.faces) // 2)
    coarse = texture_evidence(scan, model, pose)
    assert coarse != witness.evidence(pose)
    assert_alike(coarse, witness.evidence(pose), 0.2)


def test_an_even_texture_says_nothing(case, model):
    scan, pose, _ = case
    even = replace(scan, texture_linear=np.full_like(scan.texture_linear, 0.4))
    found = texture_evidence(even, model, pose)
    assert found.log_odds == 0
    assert all(abs(getattr(found, name)) < 1e-6 for name in SCORES)


def test_where_there_is_no_colour_there_is_no_evidence(case, model):
    scan, pose, witness = case
    assert texture_evidence(replace(scan, uv=None, texture_linear=None), model, pose) is None
    black = replace(scan, texture_linear=np.zeros_like(scan.texture_linear))
    assert texture_evidence(black, model, pose) is None
    assert witness.evidence(compose(np.eye(3), [0, 0, 500]) @ pose) is None
    assert ColourScorer.of(scan, replace(model, landmark_points=None)) is None


def test_a_strange_texture_cannot_refuse_a_face(case, model):
    scan, pose, _ = case
    noise = np.random.default_rng(0).uniform(size=scan.texture_linear.shape).astype(np.float32)
    found = texture_evidence(replace(scan, texture_linear=noise), model, pose)
    assert -3 <= found.log_odds <= 3
