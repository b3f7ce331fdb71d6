"""CW-SSIM: what it must not see, what it must see, and the compiled blocks beside a plain reference."""

import time
from dataclasses import replace

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from numpy.testing import assert_allclose, assert_array_equal
from skimage.metrics import structural_similarity

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import (
    Chart,
    TemplateOptions,
    Templates,
    albedo_templates,
    cw_ssim,
    similarity_matrix,
)


def reference(a, b, weight_a, weight_b, window=5, k=1e-3):
    """CW-SSIM of coefficients (O, h, w) by weights (h, w), 0 outside the masks, window by window."""
    a, b, weight_a, weight_b = (
        sliding_window_view(values, (window, window), (-2, -1))
        for values in (a.astype(complex), b.astype(complex), weight_a, weight_b)
    )
    shared = abs((a * b.conj()).sum((-2, -1)))
    energy = (abs(a) ** 2 + abs(b) ** 2).sum((-2, -1))
    alike = ((2 * shared + k) / (energy + k)).mean(0)
    whole = weight_a.all((-2, -1)) & weight_b.all((-2, -1))
    return np.average(alike, weights=whole * weight_a.mean((-2, -1)) * weight_b.mean((-2, -1)))


USUAL = 7
"""The window of the papers on CW-SSIM."""


def random_templates(seed, count, shape=(12, 15), contrast=1.0):
    """Weighed templates of noise, some places `contrast` times stronger, each with a corner masked."""
    random = np.random.default_rng(seed)
    values = random.standard_normal((count, 10, *shape, 2)).view(complex)[..., 0]
    values *= np.where(random.random(values.shape) < 0.1, contrast, 1.0)
    mask = np.ones((count, *shape), bool)
    for one in mask:
        one[: random.integers(0, 4), : random.integers(0, 6)] = False
    names = tuple(f"p{k}" for k in range(count))
    weight = (mask * random.uniform(0.01, 1, mask.shape)).astype(np.float32)
    return Templates(np.where(mask[:, None], values, 0).astype(np.complex64), mask, names, weight=weight)


def test_an_image_is_like_itself():
    alike = [cw_ssim(image, image) for image in np.random.default_rng(0).random((8, 64, 64))]
    assert_allclose(alike, 1, atol=1e-6)
    assert max(alike) <= 1  # rounding, too, stays below


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("axis", [0, 1])
def test_a_shift_of_two_pixels_is_not_seen(albedo, seed, axis):
    wide = albedo(seed, (160, 160))
    image = wide[16:144, 16:144]
    shifted = np.roll(wide, 2, axis)[16:144, 16:144]
    assert cw_ssim(image, shifted, window=USUAL) >= 0.97
    assert structural_similarity(image, shifted, data_range=1.0) <= 0.8


def test_brightness_is_not_seen_unless_asked_for(albedo):
    image = albedo(0)
    assert cw_ssim(image, 0.5 * image) == pytest.approx(1, abs=1e-6)
    as_it_is = TemplateOptions(size=None, unit_mean=False)
    # 2 a / (1 + a^2) with a = 1/2
    assert cw_ssim(image, 0.5 * image, options=as_it_is) == pytest.approx(0.8, abs=1e-3)


def test_what_is_masked_does_not_count(albedo, face_like_mask):
    a, b = albedo(0), albedo(1)
    plain = cw_ssim(a, b, face_like_mask)
    spoilt = np.where(face_like_mask, a, np.nan)
    assert cw_ssim(spoilt, b, face_like_mask) == plain
    assert cw_ssim(a, b) != plain


@pytest.mark.parametrize("window", [1, 4, 7, 12])
def test_blocks_are_the_plain_reference_weighed_by_both(window):
    a, b = random_templates(0, 3), random_templates(1, 4)
    if window == 12:
        a, b = (Templates(t.coefficients, np.ones_like(t.mask), t.names) for t in (a, b))
    fast = similarity_matrix(a, b, window=window)
    for i, j in np.ndindex(fast.shape):
        pair = a.coefficients[i], b.coefficients[j], a.weight[i], b.weight[j]
        assert fast[i, j] == pytest.approx(reference(*pair, window), abs=2e-6)


def test_strong_neighbours_do_not_spoil_weak_windows():
    a, b = random_templates(2, 2, (32, 32), contrast=100), random_templates(3, 2, (32, 32), contrast=100)
    slow = reference(a.coefficients[0], b.coefficients[1], a.weight[0], b.weight[1])
    assert similarity_matrix(a, b)[0, 1] == pytest.approx(slow, abs=1e-5)


def test_cw_ssim_is_the_plain_reference(albedo, face_like_mask):
    a, b = albedo(0), albedo(1)
    mask = face_like_mask * albedo(2)
    for mask_b in (face_like_mask, np.roll(mask, 9, axis=1)):
        templates = albedo_templates([a, b], ["a", "b"], masks=[mask, mask_b])
        slow = reference(*templates.coefficients, *templates.weight)
        assert cw_ssim(a, b, mask, mask_b=mask_b) == pytest.approx(slow, abs=1e-5)


def test_many_blocks_hold_what_pairs_hold():
    # 17 blocks of 64 in the first set, of which 16 are prepared at once; 3 in the second.
    a, b = random_templates(4, 1030, (6, 7)), random_templates(5, 131, (6, 7))
    at_once = similarity_matrix(a, b, window=3)
    assert_array_equal(similarity_matrix(a.select(range(1020, 1030)), b, window=3), at_once[1020:])
    assert_allclose(similarity_matrix(b, a, window=3).T, at_once, atol=2e-6)
    for i, j in ((0, 0), (1023, 130), (1024, 64), (5, 64)):
        pair = similarity_matrix(a.select([i]), b.select([j]), window=3)
        assert pair[0, 0] == pytest.approx(at_once[i, j], abs=1e-7)


def test_a_pair_costs_less_than_sixty_microseconds():
    templates = random_templates(6, 192, (32, 32))
    similarity_matrix(templates.select([0]), templates.select([1]))
    start = time.process_time()
    similarity_matrix(templates, templates)
    assert (time.process_time() - start) / len(templates) ** 2 < 60e-6


SMALL = np.zeros((128, 128), bool)
SMALL[60:80, 60:80] = True
WHITE = np.ones((128, 128))


@pytest.mark.parametrize(
    ("other", "options", "error", "words"),
    [
        (np.ones((64, 64)), {}, RecognitionError, r"\(64, 64\) pixels, image 0 \(128, 128\)"),
        (WHITE, {"mask": np.ones((64, 64), bool)}, RecognitionError, "its mask 64 x 64"),
        (np.ones((128, 128, 2)), {}, ValueError, r"expected \(H, W\) or"),
        (WHITE, {"mask": SMALL, "window": USUAL}, RecognitionError, "no window of 7 x 7"),
    ],
)
def test_images_that_cannot_be_compared_are_refused(other, options, error, words):
    with pytest.raises(error, match=words):
        cw_ssim(WHITE, other, **options)


def test_templates_that_cannot_be_compared_are_refused():
    a = random_templates(0, 2)
    normals = Templates(np.repeat(a.coefficients, 3, axis=1), a.mask, a.names, kind="shape")
    charted, mine = (replace(a, chart=Chart(name, (64, 64))) for name in ("default", "mine"))
    left, right = a.mask.copy(), a.mask.copy()
    left[1, :, 7:] = False
    right[0, :, :7] = False
    left, right = (Templates(a.coefficients, mask, a.names) for mask in (left, right))
    for one, two, window, error, words in (
        (a, a.select([]), 5, RecognitionError, "second set of templates is empty"),
        (a, random_templates(0, 2, (12, 12)), 5, RecognitionError, "images of one size"),
        (a, replace(a, options=TemplateOptions(size=64)), 5, RecognitionError, "differ in their options"),
        (normals, a, 5, RecognitionError, "first set is of the shape, the second of the albedo"),
        (charted, mine, 5, RecognitionError, "'default' and the second 64 x 64 texels of model 'mine'"),
        (a, a, 13, RecognitionError, "window of 13"),
        (a, a, 0, ValueError, "window is 0"),
        (left, right, 5, RecognitionError, r"template 1 \(p1\) and template 0 \(p0\)"),
    ):
        with pytest.raises(error, match=words):
            similarity_matrix(one, two, window=window)
