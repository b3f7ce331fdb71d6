"""Pictures left out of a fit are foretold as well as the noise allows."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.flash_captures import head_capture, of_pairs, samples_of

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import ReflectanceFitOptions, relighting_error

HELD_OUT = np.arange(99) % 10 == 3


@pytest.fixture(scope="module")
def samples():
    return samples_of(head_capture(400), noise=0.01)


def test_noise_is_all_that_is_left(samples):
    error = relighting_error(samples, HELD_OUT)
    assert error.relative_rmse == pytest.approx(error.noise_part, rel=0.1)
    assert error.fit.pair_count.max() <= (~HELD_OUT).sum()
    assert 33 < error.psnr_db < 45


def test_a_shadow_in_the_pictures_left_out_shows(samples):
    darker = np.where(HELD_OUT[:, None, None], 0.8, 1.0)
    error = relighting_error(replace(samples, observed_linear=darker * samples.observed_linear), HELD_OUT)
    assert error.relative_rmse == pytest.approx(0.25, abs=0.02)


def test_gains_of_flashes_go_along(samples):
    gain = np.linspace(0.8, 1.2, 11)[samples.light][:, None, None]
    stronger = replace(samples, observed_linear=gain * samples.observed_linear)
    plain = relighting_error(stronger, HELD_OUT)
    with_gains = relighting_error(stronger, HELD_OUT, options=ReflectanceFitOptions(light_gains=True))
    assert with_gains.relative_rmse < 0.5 * plain.relative_rmse


def test_what_cannot_be_left_out_is_refused(samples):
    for wrong in (np.zeros(99, bool), np.ones(99, bool)):
        with pytest.raises(ReflectanceError, match="expected a part"):
            relighting_error(samples, wrong)
    with pytest.raises(ReflectanceError, match="held_out is int64"):
        relighting_error(samples, np.zeros(99, int))
    apart = of_pairs(head_capture(400), np.array([0, 98]))
    split = samples_of(apart, noise=0.01)
    valid = split.valid.copy()
    valid[1] &= ~valid[0]
    with pytest.raises(ReflectanceError, match="show no vertex that the others do"):
        relighting_error(replace(split, valid=valid), np.array([False, True]))
