"""Frames without their bends: shapes and sizes stay, halves come to mirror each other."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses import CanonicalizationOptions, bounded_biharmonic_weights, canonicalize
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR
from scan2albedo.eyeglasses.unbending import front_halves
from scan2albedo.geometry.rigid import (
    compose,
    procrustes,
    random_rotation,
    rotation_angle_rad,
    transform_points,
)
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
        glasses, rng = eyeglasses(seed, shape=shape), np.random.default_rng(seed)
        pose = compose(random_rotation(rng), rng.normal(0, 200, 3))
        vertices = transform_points(pose, dropped(glasses.vertices))
        points = vertices[glasses.keypoint_vertices]
        weights = bounded_biharmonic_weights(vertices, glasses.faces, points, 3.0)
        made.append((glasses, vertices, points, weights))
    return made


@pytest.fixture(scope="module")
def unbent(pair):
    meshes = [(vertices, glasses.faces) for glasses, vertices, _, _ in pair]
    return canonicalize(meshes, [p for _, _, p, _ in pair], weights=[w for *_, w in pair])


def laid_on(source, target):
    return np.linalg.norm(transform_points(procrustes(source, target), source) - target, axis=1)


def lens_edges(glasses):
    return [np.linalg.norm(glasses.vertices - p[:, None], axis=2).argmin(1) for p in glasses.lens_outlines]


def test_rims_keep_their_shape_and_the_bend_goes(pair, unbent):
    for (glasses, vertices, _, _), frame in zip(pair, unbent.frames, strict=True):
        for edge in lens_edges(glasses):
            assert laid_on(frame.vertices[edge], vertices[edge]).max() < 0.05
        before, after = (laid_on(v, glasses.rest_vertices) for v in (vertices, frame.vertices))
        assert np.sqrt((before**2).mean()) > 1.5
        assert np.sqrt((after**2).mean()) < 0.2
        assert frame.unbent
        assert_allclose(frame.uncanonicalize(frame.vertices), vertices, atol=1e-9)
        flip = np.array([-1.0, 1, 1])
        assert_allclose(frame.keypoints[list(MIRROR)], frame.keypoints * flip, atol=0.1)


def test_the_mean_gives_all_frames_its_proportions(pair, unbent):
    meshes = [(vertices, glasses.faces) for glasses, vertices, _, _ in pair]
    options = CanonicalizationOptions(mode="mean")
    found = canonicalize(meshes, [p for _, _, p, _ in pair], weights=[w for *_, w in pair], options=options)
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
    mesh = (glasses.vertices, glasses.faces)
    frame = canonicalize([mesh], [glasses.keypoints], weights=[weights]).frames[0]
    assert frame.residual < 1e-6
    assert laid_on(frame.vertices, glasses.vertices).max() < 1e-6
    said = {}
    bends = {"out": GlassesBend(temple_spread_mm=8), "in": GlassesBend(temple_spread_mm=-8)}
    for name, bend in (bends | {"none": GlassesBend(), "folded": GlassesBend(bridge_deg=4)}).items():
        bent = eyeglasses(0, bend=bend)
        found = canonicalize([(bent.vertices / 10, bent.faces)], [bent.keypoints / 10], weights=[weights])
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


def test_one_half_alone_is_only_posed():
    glasses = eyeglasses(0)
    points = glasses.keypoints
    points[11:] = np.nan
    weights = np.where(np.isfinite(points).all(1), 1 / 11, 0.0) * np.ones((len(glasses.vertices), 1))
    found = canonicalize([(glasses.vertices, glasses.faces)], [points], weights=[weights])
    step = next(s for s in found.plan if s.stage == "eyeglasses.unbend")
    assert not step.ran
    assert laid_on(found.frames[0].vertices, glasses.vertices).max() < 1e-9


@pytest.mark.parametrize("mode", ["unbend", "mean"])
@pytest.mark.parametrize("count", [1, 2])
def test_a_front_without_temples_comes_out_upright(mode, count):
    meshes, marks, rests, weights = [], [], [], []
    for seed in range(count):
        glasses, rng = eyeglasses(seed), np.random.default_rng(seed + 5)
        pose = compose(random_rotation(rng), rng.normal(0, 200, 3))
        points = transform_points(pose, glasses.keypoints)
        points[TEMPLES] = np.nan
        meshes.append((transform_points(pose, glasses.vertices), glasses.faces))
        marks.append(points)
        rests.append(glasses.rest_vertices)
        known = np.isfinite(points).all(1)
        weights.append(np.where(known, 1 / known.sum(), 0.0) * np.ones((len(glasses.vertices), 1)))
    found = canonicalize(meshes, marks, weights=weights, options=CanonicalizationOptions(mode=mode))
    for frame, rest in zip(found.frames, rests, strict=True):
        turn = procrustes(rest, frame.vertices)[:3, :3]
        assert np.rad2deg(rotation_angle_rad(turn)) < 5
        height = frame.keypoints[[0, 2, 11]] - frame.keypoints[[1, 5, 14]]
        assert (height[:, 1] > 0).all()
