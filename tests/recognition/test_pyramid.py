"""The pyramid holds the whole image, and its coarsest scale is had alone for less."""

import sys

import numpy as np
import pytest

from scan2albedo.errors import MissingDependencyError
from scan2albedo.recognition import steerable_pyramid
from scan2albedo.recognition.pyramid import coarsest_bands


def test_the_image_comes_back(albedo):
    image = albedo(0)
    pyramid = steerable_pyramid(image)
    assert np.abs(pyramid.reconstructed() - image).max() <= 1e-5
    assert [bands.shape for bands in pyramid.bands] == [(10, 128, 128), (10, 64, 64), (10, 32, 32)]


@pytest.mark.parametrize(("shape", "scales", "orientations"), [((128, 128), 3, 10), ((64, 96), 2, 4)])
def test_the_coarsest_scale_alone_is_that_of_the_pyramid(albedo, shape, scales, orientations):
    image = albedo(1, shape)
    whole = steerable_pyramid(image, scales=scales, orientations=orientations).bands[-1]
    alone = coarsest_bands(image, scales=scales, orientations=orientations)
    assert np.abs(whole).max() > 0.01
    np.testing.assert_allclose(alone, whole, atol=1e-12)


def test_a_wave_answers_in_the_band_of_its_direction():
    columns = np.arange(128)
    across = np.tile(np.cos(2 * np.pi * columns / 12), (128, 1))
    strength, turned = (np.abs(coarsest_bands(wave)).mean(axis=(1, 2)) for wave in (across, across.T))
    assert strength.argmax() != turned.argmax()
    assert (
        abs(int(strength.argmax()) - int(turned.argmax())) == 5
    )  # a right angle is five of ten orientations
    assert strength.max() > 100 * strength.min()


@pytest.mark.parametrize("shape", [(128, 126), (16, 128), (128,)])
def test_sizes_the_scales_do_not_divide_are_refused(shape):
    with pytest.raises(ValueError, match="expected \\(H, W\\) of multiples of 8"):
        steerable_pyramid(np.zeros(shape))


def test_without_pyrtools_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrtools.pyramids", None)
    with pytest.raises(MissingDependencyError, match=r"pyrtools.*pip install 'scan2albedo\[recognition\]'"):
        steerable_pyramid(np.zeros((64, 64)))
