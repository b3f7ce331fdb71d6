"""Albedos as random fields with the spectrum of natural images."""

import numpy as np


def build_albedo(seed, shape=(128, 128), steepness=1.0):
    """Return a field (H, W) within [0.1, 0.9] whose amplitude falls with frequency to the given power."""
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))
    frequency[0, 0] = np.inf
    noise = np.fft.fft2(np.random.default_rng(seed).standard_normal(shape))
    field = np.fft.ifft2(noise / frequency**steepness).real
    return 0.1 + 0.8 * (field - field.min()) / np.ptp(field)
