"""Clipped channels rebuilt from surviving ones."""

import numpy as np
import pytest

from scan2albedo.albedo.saturation import restore_channels
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.textures import HEMOGLOBIN, MELANIN, smooth_noise

SIZE = 96


@pytest.fixture(scope="module")
def pigments():
    """Two pigments over one tone, a disc of texels, and the source around it."""
    uv, rng = texel_coordinates(SIZE), np.random.default_rng(0)
    absorbed = sum(
        0.1 * smooth_noise(uv, (bumps, bumps), rng)[:, None] * pigment
        for bumps, pigment in ((30, MELANIN), (12, HEMOGLOBIN))
    )
    albedo = ([0.6, 0.36, 0.25] * np.exp(-absorbed)).reshape(SIZE, SIZE, 3)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    return albedo, np.hypot(rows - 40, columns - 50) < 12


def _broken(albedo, disc, channels):
    lost = disc[..., None] & np.isin(np.arange(3), channels)
    return np.where(lost, 0.7 * albedo, albedo), lost


@pytest.mark.slow
def test_two_survivors_tell_a_third_of_two_pigments(pigments):
    albedo, disc = pigments
    broken, lost = _broken(albedo, disc, [0])
    before = broken.copy()
    restored = restore_channels(broken, lost, ~disc)
    off = np.sqrt(np.mean(((restored / albedo)[disc][:, 0] - 1) ** 2))
    assert off < 0.002
    assert off < 0.05 * (albedo[disc].std(0) / albedo[disc].mean(0))[0]
    assert np.array_equal(restored[~lost], broken[~lost])
    assert np.array_equal(broken, before)
    few = np.indices(disc.shape).max(0) < 5
    assert restore_channels(broken, lost, few) is broken


def test_one_survivor_tells_most_of_the_others(pigments):
    albedo, disc = pigments
    broken, lost = _broken(albedo, disc, [0, 1])
    restored = restore_channels(broken, lost, ~disc)
    left, before = (np.abs(image - albedo)[disc][:, :2].mean(0) for image in (restored, broken))
    assert np.all(left < 0.2 * before)
    assert np.all(left < 0.6 * albedo[disc][:, :2].std(0))


def test_the_clipped_value_is_a_lower_bound(pigments):
    albedo, disc = pigments
    _, lost = _broken(albedo, disc, [0])
    bounded = np.where(lost, 2 * albedo, albedo)
    assert np.all(restore_channels(bounded, lost, ~disc)[lost] >= bounded[lost])


def test_a_texel_without_survivors_is_left(pigments):
    albedo, disc = pigments
    broken, lost = _broken(albedo, disc, [0, 1, 2])
    assert restore_channels(broken, lost, ~disc) is broken


def test_constant_colour_keeps_its_ratio():
    albedo = np.ones((40, 40, 3)) * [0.5, 0.4, 0.3]
    lost = np.zeros((40, 40, 3), bool)
    lost[18:22, 18:22, 0] = True
    broken = np.where(lost, 0.1, albedo)
    broken[20, 20, 1:] *= 1.2
    restored = restore_channels(broken, lost, ~lost.any(-1))
    assert restored[18, 18, 0] == pytest.approx(0.5, rel=1e-9)
    assert restored[20, 20, 0] == pytest.approx(0.6, rel=1e-9)
