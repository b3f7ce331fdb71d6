import numpy as np
import pytest

from scan2albedo.io.color import linear_to_srgb
from scan2albedo.synthetic.renderer import auto_exposure, photograph


def shoot(radiance, **options):
    settings = {"exposure": 1.0, "noise": 0.0, "bits": None, "rng": np.random.default_rng(0), **options}
    return photograph(radiance, **settings)


def test_eight_bits_leave_256_levels_and_half_a_step_of_error():
    x = np.linspace(0, 1, 20001)
    stored = shoot(x, bits=8)
    assert len(np.unique(stored)) == 256
    assert np.abs(linear_to_srgb(stored) - linear_to_srgb(x)).max() <= 0.5 / 255 + 1e-6


def test_clean_picture_is_exposed_and_clipped_only():
    assert shoot(np.array([0.2, 0.5, 3.0]), exposure=0.5).tolist() == pytest.approx([0.1, 0.25, 1.0])


def test_automatic_exposure_stays_below_white():
    radiance = np.random.default_rng(0).uniform(0, 7, (10, 3))
    assert (radiance * auto_exposure(radiance)).max() == pytest.approx(0.98)
    assert auto_exposure(np.zeros(3)) == 1.0


def test_noise_has_its_standard_deviation():
    noisy = shoot(np.full(100000, 0.5), noise=0.02)
    assert noisy.std() == pytest.approx(0.02, rel=0.02)
    assert noisy.mean() == pytest.approx(0.5, abs=0.001)
