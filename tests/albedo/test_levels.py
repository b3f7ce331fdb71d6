"""Averaging texels into cells, and which texels count."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lit_scenes import hemisphere_geometry
from helpers.measures import rms
from scipy.ndimage import binary_erosion

from scan2albedo.albedo.levels import (
    along_surface,
    brightest_around,
    build_level,
    cell_field,
    cell_means,
    usable_texels,
)
from scan2albedo.core.geometry_image import GeometryImage


def make_image(size=64, **fields):
    texture = np.random.default_rng(0).uniform(0.2, 0.8, (size, size, 3)).astype(np.float32)
    return GeometryImage(*hemisphere_geometry(size), **{"texture_linear": texture, **fields})


def level_of(image, size=16):
    return build_level(image, usable_texels(image), size)


@pytest.fixture(scope="module")
def image():
    return make_image()


@pytest.fixture(scope="module")
def level(image):
    return level_of(image)


def test_values_and_weights_are_means_of_the_usable_texels_of_a_cell(image, level):
    usable = usable_texels(image)
    number, total = (
        field.reshape(16, 4, 16, 4).sum((1, 3))
        for field in (usable, np.where(usable, brightest_around(image.texture_linear, usable), 0))
    )
    some = number > 0
    assert level.value * level.unit == pytest.approx(total[some] / number[some])
    assert level.weight == pytest.approx(number[some] / 16)
    assert cell_means(level, image.position[image.mask][:, 0], image.mask) == pytest.approx(
        level.position[:, 0]
    )
    assert np.linalg.norm(level.normal, axis=1) == pytest.approx(1)
    # Anchors are texels of the surface.
    assert np.linalg.norm(level.anchor, axis=1) == pytest.approx(80)
    assert np.linalg.norm(level.anchor - level.position, axis=1).max() < 10


def test_cells_weigh_by_their_skin_where_there_is_any(image, level):
    usable, right = usable_texels(image), level.cell[:, 1] >= 8
    skin = np.where(np.arange(64) < 32, 0.0, 0.8) * np.ones((64, 1))
    weight, alike = (build_level(make_image(skin=some), usable, 16).weight for some in (skin, 0 * skin))
    # A beard is lit, too.
    assert weight == pytest.approx(np.where(right, 0.8, 0.25) * level.weight)
    assert alike == pytest.approx(level.weight)


def test_blocks_are_an_eighth_of_the_chart():
    image = make_image(128)
    blocks, count = level_of(image, 128).blocks()
    largest = [np.bincount(partition).max() for partition in blocks]
    assert largest == pytest.approx([image.mask.sum() / 8] * 2, rel=0.1)
    assert not set(blocks[0]) & set(blocks[1])
    assert count == blocks.max() + 1


def test_hidden_black_and_saturated_texels_do_not_vote():
    texture = np.full((64, 64, 3), 0.5, np.float32)
    texture[20:22, 30] = 0
    texture[30:33, 30] = 1
    valid = np.ones((64, 64), bool)
    valid[40:44, 30] = False
    image = make_image(texture_linear=texture, texture_valid=valid)
    out = image.mask & ~usable_texels(image)
    assert np.nonzero(out)[0].tolist() == [20, 21, 30, 31, 32, 40, 41, 42, 43]


def test_cell_field_is_linear_between_the_cells(image, level):
    rows = level.center[:, :1] + 1.0
    found = cell_field(level, rows, image.mask)[:, 0]
    inside = binary_erosion(image.mask, iterations=8)[image.mask]
    assert found[inside] == pytest.approx(np.argwhere(image.mask)[inside, 0] + 1.0, abs=1e-6)


def test_cell_field_fills_texels_that_did_not_vote_from_cells_beside():
    texture = np.full((64, 64, 3), 0.5, np.float32)
    texture[24:40, 28:36] = 0
    image = make_image(texture_linear=texture)
    level = level_of(image)
    field = cell_field(level, np.full((len(level.value), 1), 2.0), image.mask)
    assert field == pytest.approx(2.0)


def test_cell_field_at_full_size_is_the_values_themselves(image):
    usable, level = usable_texels(image), level_of(image, 64)
    found = cell_field(level, level.value[:, None], image.mask)[:, 0]
    assert found[usable[image.mask]] == pytest.approx(level.value)


def test_values_of_cells_follow_the_surface(image, level):
    values = np.stack([np.ones(len(level.value)), level.anchor[:, 0]], 1)
    found = along_surface(level, values, image)
    assert found[:, 0] == pytest.approx(1)
    x = image.position[image.mask][:, 0]
    assert rms(found[:, 1] - x) < 0.02 * np.ptp(x)


def test_values_of_cells_do_not_leak_over_a_cut(image):
    position = image.position.copy()
    position[:, 32:] += [0, 0, 400.0]
    apart = replace(image, position=position)
    level = level_of(apart)
    right, there = (1.0 * (place[:, 1] > 31.5) for place in (level.center, np.argwhere(image.mask)))
    assert along_surface(level, right[:, None], apart)[:, 0] == pytest.approx(there, abs=0.01)


def test_noise_does_not_brighten_the_value_that_the_search_sees():
    grey = np.float32(0.3 + 0.05 * np.random.default_rng(0).standard_normal((64, 64, 3)))
    everywhere = np.ones((64, 64), bool)
    assert brightest_around(grey, everywhere).mean() == pytest.approx(0.3, abs=0.004)


def test_the_value_follows_the_brightest_channel_and_leaves_unusable_texels_out():
    texture = np.zeros((32, 32, 3), np.float32)
    texture[:, :16], texture[:, 16:] = (0.2, 0.5, 0.1), (0.6, 0.3, 0.1)
    usable = np.ones((32, 32), bool)
    texture[4:12, :4, 2] = 1.0
    usable[4:12, :4] = False
    assert brightest_around(texture, usable)[usable] == pytest.approx(texture.max(-1)[usable])


def test_cells_lie_on_the_face_and_are_as_small_as_those_of_a_face_alone():
    whole = make_image(128)
    on_face = whole.mask & (np.abs(np.indices(whole.shape) - 64.5).max(0) < 25)
    other = whole.texture_linear.copy()
    other[:24] = 0.9
    other[:, 106:] = 0.1  # beside the face, beyond the windows in which colours are compared
    one, other = (make_image(128, on_face=on_face, texture_linear=t) for t in (whole.texture_linear, other))
    level = level_of(one)
    row, column = level.center.T.astype(int)
    assert on_face[row, column].all()
    assert level.factor == int(np.ceil(128 * np.sqrt(on_face.sum() / whole.mask.sum()) / 16))
    assert level.texels == on_face.sum()
    np.testing.assert_array_equal(level_of(other).color, level.color)
    nowhere = make_image(128, on_face=on_face & False)
    assert len(level_of(nowhere).value) == len(level_of(whole).value)
