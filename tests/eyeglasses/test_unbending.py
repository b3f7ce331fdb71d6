"""Frames without their bends: shapes and sizes stay, halves come to mirror each other."""

import re

import numpy as np
import pytest
from helpers.eyeglasses import posed
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses import CanonicalizationOptions, bounded_biharmonic_weights, canonicalize
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR
from scan2albedo.eyeglasses.unbending import front_halves
from scan2albedo.geometry.rigid import procrustes, rotation_angle_rad, transform_points
from scan2albedo.synthetic import GlassesBend, GlassesShape, eyeglasses

ROUND = GlassesShape(lens_width=44, lens_height=44, squareness=2)
FLAT = GlassesShape(lens_width=54, lens_height=28, squareness=6)
TEMPLES = [k for k, name in enumerate(KEY_POINT_NAMES) if "temple" in name or "ear" in name]


def dropped(points, turn_deg=4.0, drop_mm=3.0):
    """Points whose left half is turned about x and hangs lower, over the width of the bridge."""
    x, y, z = points.T
    rise = (1 + np.tanh(x / 5)) / 2
    angle = np.deg2rad(turn_deg) * rise
    return np.stack(
        [x, np.cos(angle) * y - np.sin(angle) * z - drop_mm * rise, np.sin(angle) * y + np.cos(angle) * z], 1
    )


@pytest.fixture(scope="module")
def pair():
    """A round frame and a flat one, posed and bent, with weights on a coarse lattice."""
    made = []
    for seed, shape in enumerate((ROUND, FLAT)):
        glasses = eyeglasses(seed, shape=shape)
        vertices = posed(dropped(glasses.vertices), seed)
        points = vertices[glasses.keypoint_vertices]
        weights = bounded_biharmonic_weights(vertices, glasses.faces, points, 3.0)
        made.append((glasses, vertices, points, weights))
    return made


def canonical(frames, mode="unbend"):
    """Canonicalise frames given by glasses, vertices, key points and weights."""
    return canonicalize(
        [(vertices, glasses.faces) for glasses, vertices, _, _ in frames],
        [points for _, _, points, _ in frames],
        weights=[weights for *_, weights in frames],
        options=CanonicalizationOptions(mode=mode),
    )


@pytest.fixture(scope="module")
def unbent(pair):
    return canonical(pair)


def laid_on(source, target):
    return row_lengths(transform_points(procrustes(source, target), source) - target)


def lens_edges(glasses):
    return [row_lengths(glasses.vertices - p[:, None]).argmin(1) for p in glasses.lens_outlines]


def test_rims_keep_their_shape_and_the_bend_goes(pair, unbent):
    for (glasses, vertices, _, _), frame in zip(pair, unbent.frames, strict=True):
        for edge in lens_edges(glasses):
            assert laid_on(frame.vertices[edge], vertices[edge]).max() < 0.05
        before, after = (laid_on(v, glasses.rest_vertices) for v in (vertices, frame.vertices))
        assert rms(before) > 1.5
        assert rms(after) < 0.2
        assert frame.unbent
        assert_allclose(frame.uncanonicalize(frame.vertices), vertices, atol=1e-9)
        assert_allclose(frame.keypoints[list(MIRROR)], frame.keypoints * [-1, 1, 1], atol=0.1)


def test_the_mean_gives_all_frames_its_proportions(pair, unbent):
    found = canonical(pair, "mean")
    assert_array_equal(found.mean_keypoints, unbent.mean_keypoints)
    heights = [np.ptp(f.vertices[lens_edges(g)[0], 1]) for (g, *_), f in zip(pair, found.frames, strict=True)]
    assert abs(heights[0] - heights[1]) < 4 < 12 < ROUND.lens_height - FLAT.lens_height
    assert not found.frames[0].unbent


def test_key_points_off_by_a_millimetre_hardly_matter(pair):
    glasses, vertices, points, weights = pair[1]
    for seed in range(3):
        rough = points + np.random.default_rng(seed).normal(0, 1, points.shape)
        halves = front_halves(vertices, glasses.faces, weights, rough)
        assert halves.bend_deg == pytest.approx(4, abs=0.1)
        by_points = front_halves(vertices, glasses.faces, 0 * weights, rough)
        assert np.isnan(by_points.apart)
        assert abs(by_points.bend_deg - 4) > abs(halves.bend_deg - 4)


def test_what_both_sides_are_bent_to_alike_stays():
    glasses = eyeglasses(0, bend=GlassesBend(temple_spread_mm=8))
    weights = bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.keypoints, 4.0)
    (frame,) = canonical([(glasses, glasses.vertices, glasses.keypoints, weights)]).frames
    assert frame.residual < 1e-6
    assert laid_on(frame.vertices, glasses.vertices).max() < 1e-6
    said = {}
    bends = {"out": GlassesBend(8), "in": GlassesBend(-8), "none": GlassesBend(), "folded": GlassesBend(0, 4)}
    for name, bend in bends.items():
        bent = eyeglasses(0, bend=bend)
        found = canonical([(bent, bent.vertices / 10, bent.keypoints / 10, weights)])
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


def even_weights(glasses, points):
    """The same share for every key point that there is."""
    known = np.isfinite(points).all(1)
    return np.tile(known / known.sum(), (len(glasses.vertices), 1))


def test_one_half_alone_is_only_posed():
    glasses = eyeglasses(0)
    points = glasses.keypoints
    points[11:] = np.nan
    found = canonical([(glasses, glasses.vertices, points, even_weights(glasses, points))])
    assert not found.plan.ran("eyeglasses.unbend")
    assert laid_on(found.frames[0].vertices, glasses.vertices).max() < 1e-9


@pytest.mark.parametrize("mode", ["unbend", "mean"])
@pytest.mark.parametrize("count", [1, 2])
def test_a_front_without_temples_comes_out_upright(mode, count):
    given = []
    for seed in range(count):
        glasses = eyeglasses(seed)
        points = posed(glasses.keypoints, seed + 5)
        points[TEMPLES] = np.nan
        given.append((glasses, posed(glasses.vertices, seed + 5), points, even_weights(glasses, points)))
    for frame, (glasses, *_) in zip(canonical(given, mode).frames, given, strict=True):
        turn = procrustes(glasses.rest_vertices, frame.vertices)[:3, :3]
        assert np.rad2deg(rotation_angle_rad(turn)) < 5
        height = frame.keypoints[[0, 2, 11]] - frame.keypoints[[1, 5, 14]]
        assert (height[:, 1] > 0).all()
