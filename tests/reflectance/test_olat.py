"""What the flash adds comes out of displayed values, with its noise, and what is wrong is told."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import OlatOptions, extract_olat

LIGHT = np.random.default_rng(0).uniform(0, 0.3, (3, 20, 30, 3))
FLASH, ROOM = 2 * LIGHT[:2], LIGHT[2]
"""Light of two flashes and of the room, nothing clipped."""


@pytest.fixture
def shown():
    """Pictures with the flash, and of the room."""
    return (FLASH + ROOM) ** (1 / 1.2), ROOM ** (1 / 1.2)


@pytest.mark.parametrize("gamma", [1.0, 1.2, 2.2])
def test_flash_light_is_recovered(gamma):
    pictures = ((FLASH + ROOM) ** (1 / gamma), ROOM ** (1 / gamma))
    olat = extract_olat(*pictures, options=OlatOptions(gamma=gamma))
    assert_allclose(olat.linear, FLASH, atol=1e-6)
    assert olat.valid.all()
    assert olat.diagnostics == ()


def test_one_room_picture_and_one_a_pair_agree(shown):
    flash, room = shown
    one, several = extract_olat(flash, room), extract_olat(list(flash), [room] * 2)
    assert (one.linear == several.linear).all()
    assert (one.sigma == several.sigma).all()


def noisy_pair(seed, flash, room, side, **options):
    """Return what is found in a pair of even pictures with noise of 0.01."""
    pictures = 0.01 * np.random.default_rng(seed).standard_normal((2, 1, side, side, 3))
    return extract_olat(flash + pictures[0], room + pictures[1], options=OlatOptions(noise=0.01, **options))


@pytest.mark.parametrize("gamma", [1.2, 2.0])
def test_sigma_is_the_spread_of_noisy_pictures(gamma):
    olat = noisy_pair(1, 0.6, 0.3, 300, gamma=gamma)
    assert olat.linear.std() == pytest.approx(float(olat.sigma.mean()), rel=0.01)
    power = 2 * gamma - 2
    expected = gamma * 0.01 * np.sqrt(0.6**power + 0.3**power)
    assert float(olat.sigma.mean()) == pytest.approx(expected, rel=0.01)


def test_negatives_are_kept_so_that_the_dark_has_no_bias():
    olat = noisy_pair(2, 0.2, 0.2, 200)
    assert (olat.linear < 0).mean() == pytest.approx(0.5, abs=0.02)
    assert abs(olat.linear.mean()) < 4 * olat.linear.std() / np.sqrt(olat.linear.size)
    assert olat.diagnostics == ()  # noise alone is no brighter room


def test_black_pixels_have_a_sigma():
    olat = extract_olat(np.zeros((1, 2, 2, 3)), np.zeros((2, 2, 3)))
    assert (olat.sigma > 0).all()


def test_saturation_takes_the_channel_and_leaves_the_others(shown):
    flash, room = shown
    flash[0, 3, 4, 0] = 1.0
    room[5, 6, 1] = 1.0
    olat = extract_olat(flash, room)
    assert olat.saturated[0, 3, 4].tolist() == [True, False, False]
    assert olat.valid[0, 3, 4].tolist() == [False, True, True]
    assert not olat.valid[:, 5, 6, 1].any()
    assert (~olat.valid).sum() == 3
    told = [(d.name, d.pair, d.left_out) for d in olat.diagnostics]
    assert told == [("saturated", pair, False) for pair in (0, 1)]


def test_nan_pixels_are_masked_and_told_and_a_pair_without_any_number_is_left_out(shown):
    flash, room = shown
    flash[1, :2, :, 2] = np.nan
    olat = extract_olat(flash, room)
    assert not olat.valid[1, :2, :, 2].any()
    assert olat.valid[1, :2, :, :2].all()
    assert np.isfinite(olat.linear).all()
    assert np.isfinite(olat.sigma).all()
    [told] = olat.diagnostics
    assert (told.name, told.pair) == ("not_finite", 1)
    assert told.part == pytest.approx(0.1)
    flash[0] = np.nan
    flash[1] = room
    olat = extract_olat(flash, room)
    assert not olat.valid[0].any()
    assert olat.valid[1].all()
    assert olat.diagnostics[0].left_out


def test_exchanged_pictures_are_left_out_by_name(shown):
    flash, room = shown
    olat = extract_olat([flash[0], room], [room, flash[1]])
    assert olat.valid[0].all()
    assert not olat.valid[1].any()
    [told] = olat.diagnostics
    assert (told.name, told.pair, told.left_out) == ("room_brighter_than_flash", 1, True)
    assert "exchanged" in told.message


def test_a_patch_brighter_in_the_room_is_told_and_kept(shown):
    flash, room = shown
    flash[0, :4] = 0.1
    room = np.maximum(room, 0.3)
    olat = extract_olat(flash, room)
    told = [d for d in olat.diagnostics if d.name == "room_brighter_than_flash" and d.pair == 0]
    assert told[0].part >= 0.2
    assert not told[0].left_out
    assert olat.valid[0, :4].all()
    assert (olat.linear[0, :4] < 0).all()


def test_values_beyond_white_need_a_saturation():
    beyond = extract_olat(255 * FLASH, ROOM, options=OlatOptions(gamma=1, saturation=np.inf))
    assert beyond.valid.all()


@pytest.mark.parametrize(
    ("flash", "room", "error"),
    [
        ((0, 4, 4, 3), (4, 4, 3), ReflectanceError),
        ((1, 4, 4, 3), (4, 5, 3), ValueError),
        ((3, 4, 4, 3), (2, 4, 4, 3), ValueError),
        ((1, 4, 4), (4, 4), ValueError),
    ],
)
def test_pictures_of_shapes_that_do_not_fit_are_refused(flash, room, error):
    with pytest.raises(error):
        extract_olat(np.zeros(flash), np.zeros(room))


@pytest.mark.parametrize(
    "wrong", [{"gamma": 0}, {"noise": 0}, {"saturation": 0}, {"gamma": np.nan}, {"noise": np.nan}]
)
def test_options_outside_their_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        OlatOptions(**wrong)


def test_pairs_that_share_a_picture_of_the_room_are_less_sure_together():
    """The mean over a camera's pairs has the spread that independent sigmas foretell."""
    rng = np.random.default_rng(5)
    pairs = 8
    flash = 0.5 + 0.02 * rng.standard_normal((pairs, 100, 100, 3))
    means = []
    for rooms in ((), (pairs,)):
        room = 0.3 + 0.02 * rng.standard_normal((*rooms, 100, 100, 3))
        found = extract_olat(flash, room, options=OlatOptions(gamma=1.2, noise=0.02))
        expected = np.sqrt((found.sigma.astype(float) ** 2).mean() / pairs)
        assert found.linear.mean(0).std() == pytest.approx(expected, rel=0.05)
        means.append(found.sigma.mean())
    assert means[1] < 0.7 * means[0]
