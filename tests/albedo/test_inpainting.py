"""Exemplar synthesis of saturated texels."""

import numpy as np
import pytest

from scan2albedo.albedo.inpainting import _order, resynthesize

SIZE = 160


@pytest.fixture(params=["skin", "wood"])
def damaged(request, scenes):
    albedo = scenes.texture(request.param, SIZE, 3)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    target = ((rows - 70) / 10) ** 2 + ((columns - 80) / 16) ** 2 < 1
    return albedo, np.where(target[..., None], 1.0, albedo), target


def test_the_texture_grows_back_with_its_statistics(damaged):
    from skimage.restoration import inpaint_biharmonic

    albedo, broken, target = damaged
    filled = resynthesize(broken, target, ~target)
    smooth = inpaint_biharmonic(broken, target, channel_axis=-1)
    spread = albedo[target].std(0)
    assert filled[target].std(0) == pytest.approx(spread, rel=0.35)
    assert np.all(np.abs(filled[target].std(0) - spread) < np.abs(smooth[target].std(0) - spread))
    assert np.mean((filled - albedo)[target] ** 2) < np.mean((broken - albedo)[target] ** 2) / 4


def test_no_seam_at_the_border(damaged):
    albedo, broken, target = damaged
    filled = resynthesize(broken, target, ~target)
    border = target[:, 1:] != target[:, :-1]
    jump = lambda image: float(np.abs(np.diff(image, axis=1))[border].mean())  # noqa: E731
    assert jump(filled) < 1.5 * jump(albedo)


def test_everything_else_keeps_its_bits_and_the_input_too(damaged):
    _, broken, target = damaged
    before = broken.copy()
    filled = resynthesize(broken, target, ~target)
    assert np.array_equal(filled[~target], broken[~target])
    assert np.array_equal(broken, before)


def test_same_seed_same_bits(damaged):
    _, broken, target = damaged
    first, again = (resynthesize(broken, target, ~target, seed=5) for _ in range(2))
    assert np.array_equal(first, again)


def test_only_sources_are_copied(damaged):
    _, broken, target = damaged
    source = ~target
    poisoned = broken.copy()
    source[:, 100:], poisoned[:, 100:] = False, 50.0
    assert resynthesize(poisoned, target, source)[target].max() < 2


def test_nothing_to_fill_or_to_copy_from_changes_nothing(damaged):
    _, broken, target = damaged
    nothing = np.zeros_like(target)
    assert resynthesize(broken, nothing, ~target) is broken
    assert resynthesize(broken, target, nothing) is broken


def test_texels_beside_the_known_come_first_and_each_once(damaged):
    *_, target = damaged
    order = _order(target, ~target)
    assert len(order) == target.sum() == len({tuple(texel) for texel in order})
    center = np.hypot((order[:, 0] - 70) / 10, (order[:, 1] - 80) / 16)
    assert center[:40].min() > 0.75
    assert center[-1] < 0.35
