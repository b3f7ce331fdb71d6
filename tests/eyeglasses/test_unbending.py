"""Frames without their bends: shapes and sizes stay, halves come to mirror each other."""

import re

import numpy as np
import pytest
from helpers.canonical_frames import GivenFrame, canonical
from helpers.eyeglasses import posed
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from scan2albedo.eyeglasses import CanonicalizationOptions, bounded_biharmonic_weights
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR
from scan2albedo.eyeglasses.unbending import front_halves
from scan2albedo.geometry.rigid import procrustes, rotation_angle_rad, transform_points
from scan2albedo.synthetic import GlassesBend, GlassesShape, eyeglasses

MEAN = CanonicalizationOptions(mode="mean")
ROUND = GlassesShape(lens_width=44, lens_height=44, squareness=2)
FLAT = GlassesShape(lens_width=54, lens_height=28, squareness=6)
TEMPLES = [k for k, name in enumerate(KEY_POINT_NAMES) if "temple" in name or "ear" in name]


def dropped(points):
    """Points whose left half is turned by 4 degrees about x and hangs 3 mm lower, beyond the bridge."""
    rise = (1 + np.tanh(points[:, :1] / 5)) / 2
    return Rotation.from_euler("x", 4 * rise, degrees=True).apply(points) - rise * [0, 3, 0]


@pytest.fixture(scope="module")
def pair():
    """A round frame and a flat one; what is given of them: posed, bent, with weights of a coarse lattice."""
    made = []
    for seed, shape in enumerate((ROUND, FLAT)):
        glasses = eyeglasses(seed, shape=shape)
        vertices = posed(dropped(glasses.vertices), seed)
        mesh = vertices, glasses.faces, vertices[glasses.keypoint_vertices]
        made.append((glasses, GivenFrame(*mesh, bounded_biharmonic_weights(*mesh, 3.0))))
    return made


@pytest.fixture(scope="module")
def unbent(pair):
    return canonical([given for _, given in pair])


def laid_on(source, target):
    return row_lengths(transform_points(procrustes(source, target), source) - target)


def lens_edges(glasses):
    return [row_lengths(glasses.vertices - p[:, None]).argmin(1) for p in glasses.lens_outlines]


def test_rims_keep_their_shape_and_the_bend_goes(pair, unbent):
    for (glasses, given), frame in zip(pair, unbent.frames, strict=True):
        for edge in lens_edges(glasses):
            assert laid_on(frame.vertices[edge], given.vertices[edge]).max() < 0.05
        before, after = (laid_on(v, glasses.rest_vertices) for v in (given.vertices, frame.vertices))
        assert rms(before) > 1.5
        assert rms(after) < 0.2
        assert frame.unbent
        assert_allclose(frame.apply(given.vertices), frame.vertices, atol=1e-12)
        assert_allclose(frame.uncanonicalize(frame.vertices), given.vertices, atol=1e-9)
        with pytest.raises(ValueError, match="vertices is"):
            frame.uncanonicalize(given.vertices[:5])
        assert_allclose(frame.keypoints[list(MIRROR)], frame.keypoints * [-1, 1, 1], atol=0.1)


def test_the_mean_gives_all_frames_its_proportions(pair, unbent):
    found = canonical([given for _, given in pair], options=MEAN)
    assert_array_equal(found.mean_keypoints, unbent.mean_keypoints)
    heights = [np.ptp(f.vertices[lens_edges(g)[0], 1]) for (g, _), f in zip(pair, found.frames, strict=True)]
    assert abs(heights[0] - heights[1]) < 4 < 12 < ROUND.lens_height - FLAT.lens_height
    assert not found.frames[0].unbent


def test_key_points_off_by_a_millimetre_hardly_matter(pair):
    given = pair[1][1]
    for seed in range(3):
        rough = given.keypoints + np.random.default_rng(seed).normal(0, 1, (20, 3))
        halves, by_points = (
            front_halves(given.vertices, given.faces, share * given.weights, rough) for share in (1, 0)
        )
        assert halves.bend_deg == pytest.approx(4, abs=0.1)
        assert np.isnan(by_points.apart)
        assert abs(by_points.bend_deg - 4) > abs(halves.bend_deg - 4)


def test_what_both_sides_are_bent_to_alike_stays():
    glasses = eyeglasses(0, bend=GlassesBend(temple_spread_mm=8))
    weights = bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.keypoints, 4.0)
    (frame,) = canonical([GivenFrame.of(glasses, weights)]).frames
    assert frame.residual < 1e-6
    assert laid_on(frame.vertices, glasses.vertices).max() < 1e-6
    said = {}
    bends = {"out": GlassesBend(8), "in": GlassesBend(-8), "none": GlassesBend(), "folded": GlassesBend(0, 4)}
    for name, bend in bends.items():
        found = canonical([GivenFrame.of(eyeglasses(0, bend=bend), weights).scaled(0.1)])
        (step,) = found.plan.of_stage("eyeglasses.common_bend")
        assert not step.ran
        said[name] = np.array([float(n) for n in re.findall(r"[-+]?\d+\.\d+", step.evidence)])
    # Rims: degrees, those of designs, their deviation, bend, its deviation. Temples: degrees, mm at the ends,
    # mm of the bow, degrees of designs, their deviation, mm of the bend, its deviation.
    out, inward, folded = (said[name] - said["none"] for name in ("out", "in", "folded"))
    assert_allclose(out[[0, 3, 6, 10]], [0, 0, 8, 8], atol=0.5)
    assert_allclose(inward[[0, 3, 6, 10]], [0, 0, -8, -8], atol=0.5)
    assert out[7] < -0.7 < 0.7 < inward[7]
    assert_allclose(folded[[0, 3, 5]], [4, 4, -4], atol=0.2)
    assert said["none"][[1, 2, 8, 9]].tolist() == [10.0, 5.8, 2.5, 4.3]


def lacking(glasses, gaps):
    """A frame without some key points, the others with even shares."""
    known = ~np.isin(np.arange(20), gaps)
    points = np.where(known[:, None], glasses.keypoints, np.nan)
    weights = np.tile(known / known.sum(), (len(glasses.vertices), 1))
    return GivenFrame(glasses.vertices, glasses.faces, points, weights)


def test_one_half_alone_is_only_posed():
    glasses = eyeglasses(0)
    found = canonical([lacking(glasses, range(11, 20))])
    assert not found.plan.ran("eyeglasses.unbend")
    assert laid_on(found.frames[0].vertices, glasses.vertices).max() < 1e-9


@pytest.mark.parametrize("mode", ["unbend", "mean"])
@pytest.mark.parametrize("count", [1, 2])
def test_a_front_without_temples_comes_out_upright(mode, count):
    made = [eyeglasses(seed) for seed in range(count)]
    given = [lacking(glasses, TEMPLES).posed(seed + 5) for seed, glasses in enumerate(made)]
    found = canonical(given, options=CanonicalizationOptions(mode=mode))
    for frame, glasses in zip(found.frames, made, strict=True):
        turn = procrustes(glasses.rest_vertices, frame.vertices)[:3, :3]
        assert np.rad2deg(rotation_angle_rad(turn)) < 5
        height = frame.keypoints[[0, 2, 11]] - frame.keypoints[[1, 5, 14]]
        assert (height[:, 1] > 0).all()
