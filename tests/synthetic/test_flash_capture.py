"""A synthetic flash capture holds what it says, and the reflectance fit finds it again."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose

from scan2albedo.geometry.pinhole import project
from scan2albedo.reflectance import (
    OlatOptions,
    extract_olat,
    rig_of_head_poses,
    sample_vertices,
)
from scan2albedo.synthetic import Portrait, flash_capture

CLEAN = Portrait(picture_size=192, noise=0.0, bits=None, saturated_part=0.0)


@pytest.fixture(scope="module")
def clean():
    return flash_capture(3, views=3, flashes=5, hair=False, portrait=CLEAN)


@pytest.fixture(scope="module")
def noisy():
    return flash_capture(3, views=3, flashes=5, portrait=Portrait(picture_size=192))


def rig_of(capture):
    return rig_of_head_poses(
        capture.head_rotations,
        capture.head_translations,
        capture.intrinsics,
        view=capture.view,
        flash=capture.light,
    )


def samples_of(capture, noise=0.01):
    olat = extract_olat(capture.flash, capture.room, options=OlatOptions(noise=noise, saturation=0.98))
    return sample_vertices(
        olat,
        rig_of(capture),
        capture.vertices,
        capture.faces,
        normals=capture.normals,
        reference_distance_mm=capture.portrait.distance_mm,
    )


def test_pictures_are_eight_bits_and_some_are_saturated(noisy):
    assert noisy.flash.dtype == np.uint8
    assert noisy.flash.shape == noisy.room.shape == (15, 192, 192, 3)
    clipped = (noisy.flash == 255).any(-1).mean()
    assert 1e-5 < clipped < 0.01
    assert noisy.flash.astype(int).sum() > noisy.room.astype(int).sum()
    assert noisy.room.max() > 20


def test_flashes_stand_where_cameras_do_and_two_above(clean):
    rig = rig_of(clean)
    assert_allclose(rig.cameras, clean.cameras)
    centers = rig.camera_positions[:: len(clean.light_gain)]
    assert clean.light_positions[:3] == pytest.approx(centers)
    assert (clean.light_positions[3:, 1] > 300).all()
    offsets = clean.light_positions - np.array([0, 0, -5.0])
    assert row_lengths(offsets) == pytest.approx(np.full(5, clean.portrait.distance_mm))


def test_colours_at_vertices_are_what_the_lobes_say(clean):
    """The renderer and the fit's lobes were written apart; on smooth skin they meet within sampling error."""
    samples = samples_of(clean, noise=1e-3)
    foretold = (
        samples.lobes[..., :1] * clean.diffuse_linear
        + np.einsum("jvs,vs->jv", samples.lobes[..., 1:], clean.weights)[..., None]
    )
    error = np.abs(samples.observed_linear / clean.exposure - foretold)[samples.valid]
    scale = rms(foretold[samples.valid])
    assert np.median(error) < 0.015 * scale
    assert np.percentile(error, 90) < 0.09 * scale


def test_landmarks_and_vertices_are_in_the_frame_of_the_cameras(clean):
    for camera in clean.cameras[:: len(clean.light_gain)]:
        pixels, depth = project(camera, clean.vertices)
        assert (depth > 700).all()
        assert ((pixels > 0) & (pixels < clean.portrait.picture_size)).all()
    nearest = np.linalg.norm(clean.landmarks[:, None] - clean.vertices[None], axis=2).min(1)
    assert nearest.max() < 3.0


@pytest.mark.slow
def test_gains_of_flashes_are_in_the_pictures():
    portrait = replace(CLEAN, picture_size=64)
    varied, even = (
        flash_capture(1, views=1, flashes=3, gain_deviation=d, room=0.0, hair=False, portrait=portrait)
        for d in (0.3, 0)
    )
    assert varied.light_gain.mean() == pytest.approx(1)
    assert np.ptp(varied.light_gain) > 0.1
    for k, gain in enumerate(varied.light_gain):
        light = [c.flash[k] ** c.portrait.gamma / c.exposure for c in (varied, even)]
        assert_allclose(light[0], gain * light[1], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_same_seed_same_bits_and_vertices_of_coarse_meshes_are_those_of_fine_ones():
    coarse, again, other, fine = (
        flash_capture(seed, views=1, flashes=1, levels=levels, portrait=Portrait(picture_size=32))
        for seed, levels in ((2, 1), (2, 1), (6, 1), (2, 2))
    )
    assert (coarse.flash == again.flash).all()
    assert (coarse.diffuse_linear == again.diffuse_linear).all()
    assert not np.allclose(coarse.vertices, other.vertices)
    count = len(coarse.vertices)
    assert (coarse.vertices == fine.vertices[:count]).all()
    assert (coarse.weights == fine.weights[:count]).all()
    assert coarse.faces.max() == count - 1


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"views": 0}, "views is 0"),
        ({"flashes": 6, "views": 3}, "6 flashes and 3 views"),
        ({"levels": 4}, "levels"),
        ({"gain_deviation": -1.0}, "gain_deviation"),
        ({"room": float("inf")}, "room"),
    ],
)
def test_arguments_out_of_range_are_refused(change, told):
    with pytest.raises(ValueError, match=told):
        flash_capture(0, **change)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("bits", 12),
        ("saturated_part", 1.0),
        ("saturated_part", -0.1),
        ("gamma", 0.0),
        ("noise", -1.0),
        ("noise", float("nan")),
        ("reach_mm", 0.0),
        ("distance_mm", float("nan")),
        ("picture_size", 0),
    ],
)
def test_cameras_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        Portrait(**{name: value})
