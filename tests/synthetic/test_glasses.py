"""Synthetic frames: closed, symmetric, one topology, with the truth about their bend."""

import numpy as np
import pytest
import trimesh
from helpers.eyeglasses import volume
from helpers.measures import row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR, SKELETON
from scan2albedo.geometry.mesh import edges_with_faces, face_areas
from scan2albedo.synthetic import GlassesBend, GlassesShape, eyeglasses

BEND = GlassesBend(temple_spread_mm=8, bridge_deg=2)


@pytest.mark.parametrize("welded", [True, False])
@pytest.mark.parametrize("nose_pads", [True, False])
def test_every_part_is_closed_and_faces_outward(welded, nose_pads):
    for seed in range(6):
        double = seed == 0
        glasses = eyeglasses(seed, welded=welded, nose_pads=nose_pads, double_bridge=double)
        assert glasses.part.max() + 1 == (1 if welded else 5) + (2 if nose_pads else 0) + double
        assert face_areas(glasses.vertices, glasses.faces).min() > 1e-3
        for part in range(glasses.part.max() + 1):
            faces = glasses.faces[glasses.part[glasses.faces[:, 0]] == part]
            closed = trimesh.Trimesh(glasses.vertices, faces, process=False)
            assert closed.is_volume
            assert closed.volume > 20
        assert 2000 < volume(glasses.vertices, glasses.faces) < 12000


def test_a_second_bridge_is_a_closed_part_above_the_first():
    plain, double = (eyeglasses(1, double_bridge=second) for second in (False, True))
    assert double.part.max() == plain.part.max() + 1
    assert_allclose(double.vertices[double.mirror], double.vertices * [-1, 1, 1], atol=1e-12)
    apart = double.keypoints - plain.keypoints
    assert np.flatnonzero(np.abs(apart).max(1)).tolist() == [0]
    assert apart[0, 1] > 5
    # Both ends are stuck into the rims.
    bar = double.vertices[double.part == double.part[double.keypoint_vertices[0]]]
    assert np.ptp(bar[:, 0]) > double.shape.bridge_width + double.shape.rim_width


def test_the_welded_frame_has_two_holes():
    glasses = eyeglasses(1, nose_pads=False)
    welded = trimesh.Trimesh(glasses.vertices, glasses.faces, process=False)
    assert welded.euler_number == 2 - 2 * 2


@pytest.mark.parametrize("welded", [True, False])
def test_an_unbent_frame_is_symmetric(welded):
    glasses = eyeglasses(2, welded=welded)
    flip = np.array([-1.0, 1, 1])
    assert_array_equal(glasses.vertices[glasses.mirror], glasses.vertices * flip)
    assert_array_equal(glasses.keypoints[list(MIRROR)], glasses.keypoints * flip)
    assert_array_equal(glasses.lens_outlines[1], glasses.lens_outlines[0] * flip)
    assert_array_equal(glasses.vertices, glasses.rest_vertices)


def test_topology_and_key_points_are_the_same_for_all_seeds_and_bends():
    first = eyeglasses(0)
    for other in (eyeglasses(5), eyeglasses(7, bend=BEND)):
        assert_array_equal(first.faces, other.faces)
        assert_array_equal(first.keypoint_vertices, other.keypoint_vertices)
    assert np.abs(eyeglasses(5).vertices - first.vertices).max() > 1
    assert_array_equal(eyeglasses(5).vertices, eyeglasses(5).vertices)


@pytest.mark.parametrize("welded", [True, False])
def test_key_points_lie_where_their_names_say(welded):
    glasses = eyeglasses(shape=GlassesShape(), welded=welded)
    at = dict(zip(glasses.names, glasses.keypoints, strict=True))
    assert glasses.names == KEY_POINT_NAMES
    assert len(set(glasses.keypoint_vertices.tolist())) == 20
    assert at["bridge_top"][1] > at["bridge_bottom"][1]
    for side, sign, rim in zip(("left", "right"), (1, -1), glasses.lens_outlines, strict=True):
        assert at[f"{side}_rim_top"][1] > rim[:, 1].max()
        assert at[f"{side}_rim_bottom"][1] < rim[:, 1].min()
        assert sign * at[f"{side}_hinge"][0] > (sign * rim[:, 0]).max()
        depth = [at[f"{side}_{n}"][2] for n in ("hinge", "temple_middle", "ear_bend", "temple_tip")]
        assert (np.diff(depth) < -10).all()
        assert at[f"{side}_temple_tip"][1] < at[f"{side}_temple_middle"][1] - 10
    lengths = row_lengths(np.ptp(glasses.keypoints[np.array(SKELETON)], axis=1))
    assert 3 < lengths.min() < lengths.max() < 70


def test_a_bend_spreads_the_temples_by_what_is_asked_and_keeps_the_volume():
    straight = eyeglasses(4)
    spread = eyeglasses(4, bend=GlassesBend(temple_spread_mm=8))
    tips = [KEY_POINT_NAMES.index(f"{side}_temple_tip") for side in ("left", "right")]
    moved = (spread.keypoints - straight.keypoints)[tips]
    assert_allclose(moved[:, :2], [[8, 0], [-8, 0]], atol=0.3)
    # A rod that turns outward reaches less far back; it does not get longer.
    assert (moved[:, 2] > 0.2).all()
    assert (moved[:, 2] < 1.0).all()
    bent = eyeglasses(4, bend=BEND)
    assert_array_equal(bent.rest_vertices, straight.vertices)
    ratio = volume(bent.vertices, bent.faces) / volume(straight.vertices, straight.faces)
    assert ratio == pytest.approx(1, abs=2e-3)
    edges, _ = edges_with_faces(bent.faces)
    one, other = (row_lengths(np.ptp(v[edges], axis=1)) for v in (bent.vertices, bent.rest_vertices))
    assert np.abs(one / other - 1).max() < 0.06


def test_lenses_lie_in_their_rims():
    glasses = eyeglasses(6, bend=BEND)
    for center, outline in zip(glasses.lens_centers, glasses.lens_outlines, strict=True):
        distance = row_lengths(outline - center)
        assert distance.min() > 12
        assert distance.max() < 40
        assert np.linalg.norm(center - (outline.min(0) + outline.max(0)) / 2) < 3
