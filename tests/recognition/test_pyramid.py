"""The coarsest scale of the pyramid is had alone, for less."""

import sys

import numpy as np
import pytest

from scan2albedo.errors import MissingDependencyError
from scan2albedo.recognition.templates import _coarsest_filters, coarsest_bands


@pytest.mark.parametrize("shape", [(128, 128), (64, 96)])
def test_the_coarsest_scale_alone_is_that_of_the_pyramid(albedo, shape):
    pyramids = pytest.importorskip("pyrtools.pyramids")
    image = albedo(1, shape)
    whole = pyramids.SteerablePyramidFreq(image, height=3, order=9, is_complex=True).pyr_coeffs
    alone = coarsest_bands(image)
    assert np.abs(alone).max() > 0.01
    np.testing.assert_allclose(alone, np.stack([whole[(2, k)] for k in range(10)]), atol=1e-12)


def test_a_wave_answers_in_the_band_of_its_direction():
    columns = np.arange(128)
    across = np.tile(np.cos(2 * np.pi * columns / 12), (128, 1))
    strength, turned = (np.abs(coarsest_bands(wave)).mean(axis=(1, 2)) for wave in (across, across.T))
    assert strength.argmax() != turned.argmax()
    # a right angle is five of ten orientations
    assert abs(int(strength.argmax()) - int(turned.argmax())) == 5
    assert strength.max() > 100 * strength.min()


def test_without_pyrtools_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrtools.pyramids", None)
    _coarsest_filters.cache_clear()
    with pytest.raises(MissingDependencyError, match=r"pyrtools.*pip install 'scan2albedo\[recognition\]'"):
        coarsest_bands(np.zeros((64, 64)))
