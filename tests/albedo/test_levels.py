"""Averaging texels into cells, and which texels count."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from scan2albedo.albedo import EstimateOptions
from scan2albedo.albedo.levels import (
    along_surface,
    brightest_around,
    build_level,
    cell_field,
    cell_means,
    usable_texels,
)
from scan2albedo.core.geometry_image import GeometryImage

OPTIONS = EstimateOptions()


@pytest.fixture
def make_image(scenes):
    def make(size=64, **fields):
        position, normal, mask = scenes.hemisphere_geometry(size)
        texture = np.random.default_rng(0).uniform(0.2, 0.8, (size, size, 3)).astype(np.float32)
        return GeometryImage(position, normal, **{"mask": mask, "texture_linear": texture, **fields})

    return make


def test_means_equal_a_loop_over_cells(make_image):
    image = make_image()
    usable = usable_texels(image)
    level = build_level(image, usable, 16)
    value, means, weights = brightest_around(image.texture_linear, usable), [], []
    for row in range(0, 64, 4):
        for column in range(0, 64, 4):
            chosen = usable[row : row + 4, column : column + 4]
            if chosen.any():
                means.append(value[row : row + 4, column : column + 4][chosen].mean())
                weights.append(chosen.mean())
    assert level.value * level.unit == pytest.approx(np.array(means))
    assert level.weight == pytest.approx(np.array(weights))
    assert np.linalg.norm(level.normal, axis=1) == pytest.approx(1)


def test_anchors_are_texels_of_the_surface(make_image):
    image = make_image()
    level = build_level(image, usable_texels(image), 16)
    assert np.linalg.norm(level.anchor, axis=1) == pytest.approx(80)
    assert np.linalg.norm(level.anchor - level.position, axis=1).max() < 10


def test_cells_weigh_by_their_skin(make_image):
    plain = make_image()
    usable = usable_texels(plain)
    skin = np.where(np.arange(64) < 32, 0.0, 0.8) * np.ones((64, 1))
    level, whole = (build_level(image, usable, 16) for image in (make_image(skin=skin), plain))
    right = whole.cell[:, 1] >= 8
    assert level.weight[right] == pytest.approx(0.8 * whole.weight[right])
    assert level.weight[~right] == pytest.approx(0.25 * whole.weight[~right])  # a beard is lit, too


def test_surfaces_without_skin_weigh_all_texels_alike(make_image):
    plain = make_image()
    usable = usable_texels(plain)
    level = build_level(make_image(skin=np.zeros((64, 64))), usable, 16)
    assert level.weight == pytest.approx(build_level(plain, usable, 16).weight)


def test_blocks_are_an_eighth_of_the_chart(make_image):
    image = make_image(128)
    level = build_level(image, usable_texels(image), 128)
    blocks, count = level.blocks()
    largest = [np.bincount(partition).max() for partition in blocks]
    assert largest == pytest.approx([image.mask.sum() / 8] * 2, rel=0.1)
    assert not set(blocks[0]) & set(blocks[1])
    assert count == blocks.max() + 1


def test_hidden_black_and_saturated_texels_do_not_vote(make_image):
    texture = np.full((64, 64, 3), 0.5, np.float32)
    texture[20:24, 30] = 0
    texture[30:34, 30] = 1
    valid = np.ones((64, 64), bool)
    valid[40:44, 30] = False
    image = make_image(texture_linear=texture, texture_valid=valid)
    out = image.mask & ~usable_texels(image)
    assert sorted(np.nonzero(out)[0]) == [*range(20, 24), *range(30, 34), *range(40, 44)]


def test_cell_field_is_linear_between_the_cells(make_image):
    image = make_image()
    level = build_level(image, usable_texels(image), 16)
    rows = level.center[:, :1] + 1.0
    found = cell_field(level, rows, image.mask)[:, 0]
    inside = binary_erosion(image.mask, iterations=8)[image.mask]
    assert found[inside] == pytest.approx(np.argwhere(image.mask)[inside, 0] + 1.0, abs=1e-6)


def test_cell_field_fills_texels_that_did_not_vote_from_cells_beside(make_image):
    texture = np.full((64, 64, 3), 0.5, np.float32)
    texture[24:40, 28:36] = 0
    image = make_image(texture_linear=texture)
    level = build_level(image, usable_texels(image), 16)
    field = cell_field(level, np.full((len(level.value), 1), 2.0), image.mask)
    assert field == pytest.approx(2.0)


def test_cell_field_at_full_size_is_the_values_themselves(make_image):
    image = make_image()
    usable = usable_texels(image)
    level = build_level(image, usable, 64)
    found = cell_field(level, level.value[:, None], image.mask)[:, 0]
    assert found[usable[image.mask]] == pytest.approx(level.value)


def test_values_of_cells_follow_the_surface(make_image):
    image = make_image()
    level = build_level(image, usable_texels(image), 16)
    values = np.stack([np.ones(len(level.value)), level.anchor[:, 0]], 1)
    found = along_surface(level, values, image)
    assert found[:, 0] == pytest.approx(1)
    off = found[:, 1] - image.position[image.mask][:, 0]
    assert np.sqrt(np.mean(off**2)) < 0.02 * np.ptp(image.position[image.mask][:, 0])


def test_values_of_cells_do_not_leak_over_a_cut(make_image):
    image = make_image()
    position = image.position.copy()
    position[:, 32:] += [0, 0, 400.0]
    apart = GeometryImage(position, image.normal, image.mask, texture_linear=image.texture_linear)
    level = build_level(apart, usable_texels(apart), 16)
    right = level.center[:, 1] > 31.5
    found = along_surface(level, right[:, None].astype(float), apart)[:, 0]
    assert found == pytest.approx((np.argwhere(image.mask)[:, 1] > 31.5).astype(float), abs=0.01)


def test_means_over_cells_are_those_of_their_texels(make_image):
    image = make_image()
    level = build_level(image, usable_texels(image), 16)
    x = image.position[image.mask][:, 0]
    assert cell_means(level, x, image.mask) == pytest.approx(level.position[:, 0])


def test_noise_does_not_brighten_the_value_that_the_search_sees():
    rng = np.random.default_rng(0)
    grey = np.float32(0.3 + 0.05 * rng.standard_normal((64, 64, 3)))
    everywhere = np.ones((64, 64), bool)
    assert grey.max(-1).mean() == pytest.approx(0.3 + 0.846 * 0.05, abs=0.002)
    assert brightest_around(grey, everywhere).mean() == pytest.approx(0.3, abs=0.004)


def test_the_value_follows_the_brightest_channel_and_leaves_unusable_texels_out():
    texture = np.zeros((32, 32, 3), np.float32)
    texture[:, :16], texture[:, 16:] = (0.2, 0.5, 0.1), (0.6, 0.3, 0.1)
    usable = np.ones((32, 32), bool)
    texture[4:12, :4, 2] = 1.0
    usable[4:12, :4] = False
    assert brightest_around(texture, usable)[usable] == pytest.approx(texture.max(-1)[usable])


def test_cells_lie_on_the_face_and_are_as_small_as_those_of_a_face_alone(make_image):
    whole = make_image(128)
    on_face = np.zeros(whole.shape, bool)
    on_face[40:90, 40:90] = whole.mask[40:90, 40:90]
    other = whole.texture_linear.copy()
    other[:24] = 0.9
    other[:, 106:] = 0.1  # beside the face, beyond the windows in which colours are compared
    one, other = (make_image(128, on_face=on_face, texture_linear=t) for t in (whole.texture_linear, other))
    level = build_level(one, usable_texels(one), 16)
    row, column = level.center.T.astype(int)
    assert on_face[row, column].all()
    assert level.factor == int(np.ceil(128 * np.sqrt(on_face.sum() / whole.mask.sum()) / 16))
    assert level.texels == on_face.sum()
    np.testing.assert_array_equal(build_level(other, usable_texels(other), 16).color, level.color)
    nowhere = make_image(128, on_face=np.zeros(whole.shape, bool))
    assert len(build_level(nowhere, usable_texels(nowhere), 16).value) == len(
        build_level(whole, usable_texels(whole), 16).value
    )
