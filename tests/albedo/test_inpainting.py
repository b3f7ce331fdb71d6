"""Exemplar synthesis of saturated texels."""

import numpy as np
import pytest
from helpers.lit_scenes import local_variance, texture
from scipy.ndimage import binary_erosion
from skimage.restoration import inpaint_biharmonic

from scan2albedo.albedo.inpainting import _order, resynthesize

SIZE = 160


ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE]
TARGET = ((ROWS - 70) / 10) ** 2 + ((COLUMNS - 80) / 16) ** 2 < 1


def _damaged(kind, seed=3):
    """Return an albedo, and it with white texels to fill."""
    albedo = texture(kind, SIZE, seed)
    return albedo, np.where(TARGET[..., None], 1.0, albedo)


@pytest.fixture(params=["skin", "wood"])
def damaged(request):
    return _damaged(request.param)


def _log_variance(image):
    """Return the logarithm of the mean local variance inside."""
    return np.log(local_variance(image)[binary_erosion(TARGET, np.ones((5, 5)))].mean())


@pytest.mark.parametrize("kind", ["skin", "wood"])
def test_the_texture_grows_back_with_its_statistics(kind):
    """Any one hole differs from its neighbourhood by chance; over six the local variance has to agree."""
    ours, smooth = [], []
    for seed in range(6):
        albedo, broken = _damaged(kind, seed)
        filled = resynthesize(broken, TARGET, ~TARGET, seed=seed)
        true = _log_variance(albedo)
        ours.append(_log_variance(filled) - true)
        smooth.append(_log_variance(inpaint_biharmonic(broken, TARGET, channel_axis=-1)) - true)
        assert np.mean((filled - albedo)[TARGET] ** 2) < np.mean((broken - albedo)[TARGET] ** 2) / 4
    assert np.exp(np.mean(ours)) == pytest.approx(1, abs=0.2)
    assert np.exp(np.mean(smooth)) < 0.5


def test_there_is_no_seam_and_everything_else_keeps_its_bits(damaged):
    albedo, broken = damaged
    before = broken.copy()
    filled, again = (resynthesize(broken, TARGET, ~TARGET, seed=5) for _ in range(2))
    assert np.array_equal(filled, again)
    assert np.array_equal(filled[~TARGET], broken[~TARGET])
    assert np.array_equal(broken, before)
    border = TARGET[:, 1:] != TARGET[:, :-1]
    jump, true_jump = (np.abs(np.diff(image, axis=1))[border].mean() for image in (filled, albedo))
    assert jump < 1.5 * true_jump


def test_only_sources_are_copied(damaged):
    poisoned = damaged[1].copy()
    poisoned[:, 100:] = 50.0
    assert resynthesize(poisoned, TARGET, ~TARGET & (COLUMNS < 100))[TARGET].max() < 2


def test_nothing_to_fill_or_to_copy_from_changes_nothing(damaged):
    _, broken = damaged
    for target, source in ((TARGET & False, ~TARGET), (TARGET, TARGET & False)):
        assert resynthesize(broken, target, source) is broken


def test_texels_beside_the_known_come_first_and_each_once():
    order = _order(TARGET, ~TARGET)
    assert len(order) == TARGET.sum() == len({tuple(texel) for texel in order.tolist()})
    center = np.hypot((order[:, 0] - 70) / 10, (order[:, 1] - 80) / 16)
    assert center[:40].min() > 0.75
    assert center[-1] < 0.35


def test_context_is_compared_with_but_not_copied(damaged):
    albedo, _ = damaged
    source = ~TARGET & (COLUMNS < 60)
    context = ~TARGET & ~source
    marked = np.where(context[..., None], albedo * [1.0, 1.0, 3.0], albedo)
    images = (albedo, *(resynthesize(marked, TARGET, source, context=c) for c in (None, context)))
    blue, alone, beside = (np.median((image[..., 2] / image[..., 0])[TARGET]) for image in images)
    # The blend carries the border's colour inwards; nothing else does.
    assert alone == pytest.approx(blue, rel=0.05)
    assert beside > 1.5 * blue


def test_an_island_without_any_neighbour_is_filled_too(damaged):
    albedo, _ = damaged
    source = np.maximum(abs(ROWS - 12), abs(COLUMNS - 12)) < 2
    filled = resynthesize(albedo, (ROWS == 150) & (COLUMNS == 150), source)
    assert filled[150, 150] == pytest.approx(albedo[source].mean(0), rel=0.5)
