"""Albedos of any size become templates of one size, by the coarsest scale alone; what cannot is named."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import MissingDependencyError, RecognitionError
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.recognition import TemplateOptions, Templates, albedo_templates, similarity_matrix
from scan2albedo.recognition.templates import (
    _coarsest_filters,
    averaged_down,
    coarsest_bands,
    supported_mask,
    without_holes,
)


def template_of(image, mask=None, **options):
    masks = None if mask is None else [mask]
    return albedo_templates([image], ["ann"], masks=masks, options=TemplateOptions(**options))


def test_sizes_are_brought_to_one(albedo):
    large = albedo(0, (384, 384), steepness=1.5)
    half = large.reshape(192, 2, 192, 2).mean(axis=(1, 3))
    options = TemplateOptions(size=128)
    templates = albedo_templates([large, half, albedo(1)], ["ann", "ann", "bob"], options=options)
    assert templates.coefficients.shape == (3, 10, 32, 32)
    similarity = similarity_matrix(templates, templates)
    assert similarity[0, 1] > 0.999
    assert similarity[0, 2] < 0.65


def test_averages_take_valid_pixels_only():
    image = np.array([[1.0, 3, 5, 0], [0, 0, 7, 0], [2, 2, 4, 0], [2, 2, 0, 0]])
    small, valid = averaged_down(image, image > 0, 2, "image")
    assert_array_equal(valid, [[True, True], [True, False]])
    assert_allclose(small, [[2, 6], [2, 0]])


def test_of_colours_the_luminance_is_compared(albedo):
    color = np.stack([albedo(0), 0.5 * albedo(1), 0.2 * albedo(2)], axis=2)
    gray = color @ [0.2126, 0.7152, 0.0722]
    of_color, of_gray = map(template_of, (color, gray))
    assert_allclose(of_color.coefficients, of_gray.coefficients, atol=1e-7)


def test_a_coefficient_is_valid_when_its_surroundings_are():
    mask = np.ones((16, 16), bool)
    mask[6, 9] = False
    expected = np.ones((4, 4), bool)
    expected[1:3, 2] = False  # pixel 6 is two away from pixels 4 and 8; 9 is one away from 8, three from 12
    assert_array_equal(supported_mask(mask), expected)


def test_the_outline_of_a_mask_is_no_feature(face_like_mask):
    flat = np.where(face_like_mask, 0.5, 0.0)
    assert (filled_from_nearest(flat, face_like_mask) == 0.5).all()
    coefficients = template_of(flat, face_like_mask).coefficients
    assert np.abs(coefficients).max() < 1e-4


@pytest.mark.parametrize("side", [128, 121])
def test_edges_do_not_wrap_around(side):
    # A ramp has no feature but the jump that wrapping it around would make.
    ramp = np.tile(np.linspace(0.5, 1.5, side), (side, 1))
    kept = template_of(ramp, size=None).coefficients
    wrapped = coarsest_bands(ramp[: side // 8 * 8, : side // 8 * 8])
    assert np.abs(kept).max() < 0.1 * np.abs(wrapped).max()


@pytest.mark.parametrize(("size", "shape"), [(256, (128, 128)), (None, (100, 130)), (None, (33, 47))])
def test_smaller_images_keep_their_size_and_others_when_asked(albedo, size, shape):
    templates = template_of(albedo(0, shape), size=size)
    assert templates.coefficients.shape == (1, 10, -(-shape[0] // 4), -(-shape[1] // 4))


@pytest.mark.parametrize(
    ("sides", "names", "error", "words"),
    [
        ((128, 64), ["ann", "bob"], RecognitionError, r"image 1 \(bob\) has \(64, 64\) .* of one size"),
        ((), [], RecognitionError, "no image was given"),
        ((128,), ["ann", "bob"], ValueError, "1 images, 2 names"),
    ],
)
def test_images_that_cannot_be_used_are_named(albedo, sides, names, error, words):
    with pytest.raises(error, match=words):
        albedo_templates([albedo(0, (side, side)) for side in sides], names)


def test_templates_that_cannot_be_used_are_named(albedo):
    good = albedo_templates([albedo(0), albedo(1)], ["ann", "bob"])
    spoilt = good.coefficients.copy()
    spoilt[1, 0, 0, 0] = np.nan
    nothing = good.mask & np.array([False, True])[:, None, None]
    for coefficients, mask, names, error, words in (
        (spoilt, good.mask, good.names, RecognitionError, r"template 1 \(bob\) is not finite"),
        (good.coefficients, nothing, good.names, RecognitionError, r"template 0 \(ann\) is masked"),
        (good.coefficients, good.mask, ("ann", " "), RecognitionError, "template 1 has an empty name"),
        (good.coefficients, good.mask, ("ann",), ValueError, "do not fit"),
    ):
        with pytest.raises(error, match=words):
            Templates(coefficients, mask, names)


@pytest.mark.parametrize("size", [0, -3, 2.5, float("nan"), "256"])
def test_sizes_out_of_range_are_refused(size):
    with pytest.raises(ValueError, match="size is "):
        TemplateOptions(size=size)


def test_small_holes_are_filled_and_large_ones_stay(albedo):
    rows, columns = np.mgrid[:128, :128]
    mask = np.ones((128, 128), bool)
    mask[np.hypot(rows - 40, columns - 40) < 2.5] = False
    mask[np.hypot(rows - 90, columns - 90) < 9] = False
    holed = np.where(mask, albedo(0, steepness=2.0), 7.0)
    closed = template_of(holed, mask)
    assert closed.mask[0, [10, 22], [10, 22]].tolist() == [True, False]
    # What stood in the hole was never seen: the coefficient is that of its surroundings.
    whole = template_of(albedo(0, steepness=2.0))
    scale = np.abs(whole.coefficients).mean()
    assert np.abs(closed.coefficients - whole.coefficients)[0, :, 10, 10].max() < 2 * scale


def test_a_mask_that_reaches_the_edge_is_not_widened_beyond_it():
    mask = np.zeros((64, 64), bool)
    mask[10:, 5:50] = True
    assert_array_equal(without_holes(mask, 0.1), mask)


def test_templates_are_selected_in_order(albedo):
    both = albedo_templates([albedo(0), albedo(1)], ["ann", "bob"])
    chosen = both.select([1, 0, 1])
    assert chosen.names == ("bob", "ann", "bob")
    for name, array in chosen.arrays.items():
        assert_array_equal(array, both.arrays[name][[1, 0, 1]])


@pytest.mark.parametrize("shape", [(128, 128), (64, 96)])
def test_the_coarsest_scale_alone_is_that_of_the_pyramid(albedo, shape):
    pyramids = pytest.importorskip("pyrtools.pyramids")
    image = albedo(1, shape)
    whole = pyramids.SteerablePyramidFreq(image, height=3, order=9, is_complex=True).pyr_coeffs
    alone = coarsest_bands(image)
    assert np.abs(alone).max() > 0.01
    assert_allclose(alone, np.stack([whole[(2, k)] for k in range(10)]), atol=1e-12)


def test_without_pyrtools_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrtools.pyramids", None)
    _coarsest_filters.cache_clear()
    with pytest.raises(MissingDependencyError, match=r"pyrtools.*pip install 'scan2albedo\[recognition\]'"):
        coarsest_bands(np.zeros((64, 64)))
