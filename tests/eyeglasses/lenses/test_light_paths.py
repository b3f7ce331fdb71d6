"""Ways of light to points: against rays one by one, and taken over from neighbours."""

import numpy as np
import pytest

from scan2albedo.eyeglasses import LensMaterial, Surface, distant_directions
from scan2albedo.eyeglasses.lenses.inserted_lenses import insert_lens
from scan2albedo.eyeglasses.lenses.lens_scene import LensScene
from scan2albedo.eyeglasses.lenses.light_kernels import AWAY, DARK
from scan2albedo.eyeglasses.lenses.light_paths import all_at_once, light_paths, pixel_stages
from scan2albedo.geometry.pinhole import (
    camera_centers,
    look_at,
    normalized_cameras,
    pixel_directions,
    pixel_grid,
)
from scan2albedo.synthetic import eyeglasses

BENT = eyeglasses(1)
SHAPE = (60, 80)
TOWARD = distant_directions(16)


def looked_at(pixels):
    """Points of glasses before a wall that pixels see, and the pixels that see any."""
    corners = np.array([[-60.0, -60, -30], [60, -60, -30], [60, 60, -30], [-60, 60, -30]])
    wall = Surface(corners, [[0, 1, 2], [0, 2, 3]])
    scene = LensScene(Surface(BENT.vertices, BENT.faces), [wall])
    camera = normalized_cameras(look_at([80, 60, 500], [0, 0, 0], focal_px=300, shape=SHAPE)[None])[0]
    directions = pixel_directions(camera, pixels)
    origins = np.broadcast_to(camera_centers(camera[None])[0], directions.shape)
    hits = scene.caster.first_hit(origins, directions)
    on = np.flatnonzero(hits.face >= 0)
    kept = type(hits)(hits.face[on], hits.barycentric[on], hits.distance[on])
    return scene, pixels[on], scene.points(origins[on], directions[on], kept)


def parts(pixels, n=3):
    steps = (np.arange(n) + 0.5) / n - 0.5
    return (pixels[:, None] + np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)).reshape(-1, 2)


def test_paths_are_what_single_rays_say():
    scene, _, points = looked_at(pixel_grid(SHAPE))
    lenses = [insert_lens(BENT.vertices, BENT.faces, BENT.keypoints, s, LensMaterial()) for s in (0, 1)]
    paths = light_paths(
        scene.caster,
        lenses,
        points.position,
        points.normal,
        TOWARD,
        stages=all_at_once(len(points.face)),
        offset_mm=0.2,
    )
    ways = set()
    for k, toward in enumerate(TOWARD):
        facing = points.normal @ toward > 0
        open_ = ~scene.caster.occluded(points.position + 0.2 * points.normal, toward)
        through = [lens.caster.occluded(points.position, toward) for lens in lenses]
        expected = np.where(open_, 1 + through[0] + 2 * through[1], DARK)
        np.testing.assert_array_equal(paths[:, k], np.where(facing, expected, AWAY))
        ways |= set(paths[:, k].tolist())
    assert ways >= {DARK, 1, 2, 3, AWAY}


@pytest.mark.parametrize("fine", [False, True])
def test_every_point_asks_only_neighbours_that_know(fine):
    pixels = pixel_grid(SHAPE)
    _, pixels, points = looked_at(parts(pixels) if fine else pixels)
    stages = pixel_stages(pixels, points)
    done = np.zeros(len(pixels), bool)
    for stage in stages:
        asks = stage.near[:, 0] >= 0
        assert (asks == (stage.near >= 0).all(1)).all()
        near = stage.near[asks]
        assert done[near].all()
        apart = np.abs(np.round(pixels[near]) - np.round(pixels[stage.point[asks], None])).max(initial=0)
        assert apart <= 1
        assert (points.surface[near] == points.surface[stage.point[asks], None]).all()
        assert not done[stage.point].any()
        done[stage.point] = True
    assert done.all()
    first = len(stages[0].point) / len(pixels)
    assert first < (0.35 if fine else 0.55)


@pytest.mark.parametrize("fine", [False, True])
def test_neighbours_rarely_err(fine):
    pixels = pixel_grid(SHAPE)
    scene, pixels, points = looked_at(parts(pixels) if fine else pixels)
    shared, alone = (
        light_paths(scene.caster, (), points.position, points.normal, TOWARD, stages=stages, offset_mm=0.2)
        for stages in (pixel_stages(pixels, points), all_at_once(len(pixels)))
    )
    np.testing.assert_array_equal(shared == AWAY, alone == AWAY)
    assert (shared != alone).mean() < 0.01
    assert (alone == DARK).mean() > 0.02


def test_no_points_have_no_paths():
    scene, _, points = looked_at(np.zeros((0, 2)))
    assert pixel_stages(np.zeros((0, 2)), points) == []
    paths = light_paths(scene.caster, (), points.position, points.normal, TOWARD, stages=[], offset_mm=0.2)
    assert paths.shape == (0, 16)
