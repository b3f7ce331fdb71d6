"""Exemplar synthesis of saturated texels."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, uniform_filter
from skimage.restoration import inpaint_biharmonic

from scan2albedo.albedo.inpainting import _order, resynthesize

SIZE = 160


@pytest.fixture(params=["skin", "wood"])
def damaged(request, scenes):
    albedo = scenes.texture(request.param, SIZE, 3)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    target = ((rows - 70) / 10) ** 2 + ((columns - 80) / 16) ** 2 < 1
    return albedo, np.where(target[..., None], 1.0, albedo), target


def _local_variance(image, target):
    value = np.log(image.max(-1))
    variance = uniform_filter(value**2, 7) - uniform_filter(value, 7) ** 2
    return float(variance[binary_erosion(target, np.ones((5, 5)))].mean())


@pytest.mark.parametrize("kind", ["skin", "wood"])
def test_the_texture_grows_back_with_its_statistics(scenes, kind):
    """Any one hole differs from its neighbourhood by chance; over six the local variance has to agree."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    target = ((rows - 70) / 10) ** 2 + ((columns - 80) / 16) ** 2 < 1
    ours, smooth = [], []
    for seed in range(6):
        albedo = scenes.texture(kind, SIZE, seed)
        broken = np.where(target[..., None], 1.0, albedo)
        filled = resynthesize(broken, target, ~target, seed=seed)
        true = _local_variance(albedo, target)
        ours.append(np.log(_local_variance(filled, target) / true))
        blurred = inpaint_biharmonic(broken, target, channel_axis=-1)
        smooth.append(np.log(_local_variance(blurred, target) / true))
        assert np.mean((filled - albedo)[target] ** 2) < np.mean((broken - albedo)[target] ** 2) / 4
    assert np.exp(np.mean(ours)) == pytest.approx(1, abs=0.2)
    assert np.exp(np.mean(smooth)) < 0.5


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
    source[:, 100:] = False
    poisoned[:, 100:] = 50.0
    assert resynthesize(poisoned, target, source)[target].max() < 2


def test_nothing_to_fill_or_to_copy_from_changes_nothing(damaged):
    _, broken, target = damaged
    nothing = np.zeros_like(target)
    assert resynthesize(broken, nothing, ~target) is broken
    assert resynthesize(broken, target, nothing) is broken


def test_texels_beside_the_known_come_first_and_each_once(damaged):
    *_, target = damaged
    order = _order(target, ~target)
    assert len(order) == target.sum() == len({tuple(texel) for texel in order.tolist()})
    center = np.hypot((order[:, 0] - 70) / 10, (order[:, 1] - 80) / 16)
    assert center[:40].min() > 0.75
    assert center[-1] < 0.35


def test_context_is_compared_with_but_not_copied(damaged):
    albedo, _, target = damaged
    source = ~target
    source[:, 60:] = False
    context = ~target & ~source
    marked = np.where(context[..., None], albedo * [1.0, 1.0, 3.0], albedo)
    alone, beside = (resynthesize(marked, target, source, context=c) for c in (None, context))
    blue = lambda image: float(np.median((image[..., 2] / image[..., 0])[target]))  # noqa: E731
    # The blend carries the border's colour inwards; nothing else does.
    assert blue(alone) == pytest.approx(blue(albedo), rel=0.05)
    assert blue(beside) > 1.5 * blue(albedo)


def test_an_island_without_any_neighbour_is_filled_too(damaged):
    albedo, _, target = damaged
    island, source = np.zeros_like(target), np.zeros_like(target)
    island[150, 150], source[10:14, 10:14] = True, True
    filled = resynthesize(albedo, island, source)
    assert filled[150, 150] == pytest.approx(albedo[10:14, 10:14].mean((0, 1)), rel=0.5)
