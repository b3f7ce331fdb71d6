"""What colours say of a pose: for the right one, against it upside down, nothing where they show nothing."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.square import vertex_colors

from scan2albedo.geometry.rigid import compose, rotation_from_vector
from scan2albedo.registration.evidence import colour_scorer
from scan2albedo.synthetic import Scanner, raw_scan

UPSIDE_DOWN = compose(rotation_from_vector([0, 0, np.pi]), np.zeros(3))


@pytest.fixture(scope="module", params=range(4))
def case(request, model):
    """A coloured scan, its right pose, and what is asked of its colours."""
    scanner = Scanner(size=32, picture_size=300, spacing_mm=4.0)
    scan, truth = raw_scan(request.param, scanner=scanner)
    return scan, truth.model_from_scan, colour_scorer(scan, model)


def test_the_right_pose_is_likely_and_others_are_not(case):
    _, pose, witness = case
    right = witness(pose, 1.0)
    assert right > 0.5
    assert witness(UPSIDE_DOWN @ pose, 1.0) < right - 1
    for shift in ([0, 20, 0], [0, -20, 0]):
        assert witness(compose(np.eye(3), shift) @ pose, 1.0) <= right


def test_the_strength_of_the_light_does_not_matter(case, model):
    scan, pose, witness = case
    dark = replace(scan, texture_linear=scan.texture_linear * 0.1)
    assert colour_scorer(dark, model)(pose, 1.0) == pytest.approx(witness(pose, 1.0), abs=0.1)


def test_colours_of_vertices_say_the_same(case, model):
    scan, pose, _ = case
    plain = replace(scan, uv=None, texture_linear=None, vertex_color_linear=vertex_colors(scan))
    assert colour_scorer(plain, model)(pose, 1.0) > 0


def test_neither_winding_nor_fine_triangles_matter(case, model, monkeypatch):
    scan, pose, witness = case
    right = witness(pose, 1.0)
    assert colour_scorer(scan.inside_out(), model)(pose, 1.0) == pytest.approx(right, abs=0.3)
    monkeypatch.setattr("scan2albedo.registration.evidence._MOST_FACES", len(scan.faces) // 2)
    assert colour_scorer(scan, model)(pose, 1.0) == pytest.approx(right, abs=1.0)


def test_an_even_texture_says_hardly_anything(case, model):
    scan, pose, _ = case
    even = replace(scan, texture_linear=np.full_like(scan.texture_linear, 0.4))
    witness = colour_scorer(even, model)
    assert abs(witness(pose, 1.0)) < 1
    assert witness(UPSIDE_DOWN @ pose, 1.0) == pytest.approx(witness(pose, 1.0), abs=0.5)


def test_where_there_is_no_colour_there_is_no_evidence(case, model):
    scan, pose, witness = case
    assert colour_scorer(replace(scan, uv=None, texture_linear=None), model) is None
    black = replace(scan, texture_linear=np.zeros_like(scan.texture_linear))
    assert colour_scorer(black, model)(pose, 1.0) == 0
    assert witness(compose(np.eye(3), [0, 0, 500]) @ pose, 1.0) == 0
    assert colour_scorer(scan, replace(model, face_uv=None)) is None


def test_a_strange_texture_cannot_refuse_a_face(case, model):
    scan, pose, _ = case
    noise = np.random.default_rng(0).random(scan.texture_linear.shape, np.float32)
    assert -3 <= colour_scorer(replace(scan, texture_linear=noise), model)(pose, 1.0) <= 3
