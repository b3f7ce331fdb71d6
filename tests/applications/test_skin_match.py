"""Colours of two skins matched, and features of two albedos brought together."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.faces import painted, square
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import swap_texture
from scan2albedo.unlit.face_features import displacement, skin_gains, warped, without_light_left


def test_the_tint_of_the_light_is_matched_on_skin_alone(person):
    face, tint = person(0), np.array([1.3, 1.0, 0.6])
    tinted = painted(face, face.mask, face.albedo_linear * tint)
    assert_allclose(skin_gains(tinted, face), 1 / tint, rtol=1e-5)
    # Hair on the other face does not count as skin.
    hair = square(face, (10, 15), (28, 36))
    bare = face.mask & ~hair
    skin = replace(face.image, skin=bare.astype(float))
    made = swap_texture(face, replace(painted(tinted, hair, 0.01), image=skin))
    assert_allclose(made.albedo_linear[bare], face.albedo_linear[bare], rtol=2e-3)


def test_black_albedos_are_not_scaled(person):
    black = painted(person(0), person(0).mask, 0)
    assert_array_equal(skin_gains(black, person(1)), 1.0)


def spots(shift):
    row, column = np.indices((256, 256))
    value = np.full((256, 256), 0.5)
    for y, x in ((90, 80), (90, 170), (180, 128)):
        value -= 0.35 * np.exp(-((row - y) ** 2 + ((column - x - shift) / 2) ** 2) / 60)
    return np.repeat(value[..., None], 3, 2)


def test_features_that_lie_apart_are_brought_together():
    mask, a, b = np.ones((256, 256), bool), spots(0), spots(6)
    assert np.abs(displacement(a, a, mask)).max() < 0.05
    beside = displacement(a, b, mask)
    assert beside[90, 80] == pytest.approx([6, 0], abs=1)
    assert np.abs(beside[20, 20]).max() < 0.5
    half = warped(a, -0.5 * beside), warped(b, 0.5 * beside)
    assert np.abs(half[0] - half[1]).max() < 0.4 * np.abs(a - b).max()
    # Once there, not twice as in a plain mean: the middle of the blend is as dark as the spots are.
    assert (half[0] + half[1])[90, 83, 0] / 2 == pytest.approx(a[90, 80, 0], abs=0.03)


def test_light_left_in_an_unsure_albedo_goes_and_a_sure_one_stays(two_people):
    """A smooth shade over one half of a face; what people differ by is known from the rest."""
    a, b = two_people
    ramp = np.broadcast_to(np.linspace(-0.5, 0.5, a.mask.shape[1]), a.mask.shape)
    shaded = painted(b, b.mask, b.albedo_linear * np.exp(ramp)[..., None])

    def left(own, others):
        """Return the part of the shade that is left."""
        faces = (
            replace(face, expected_error=np.full(face.mask.shape, error, np.float32))
            for face, error in ((shaded, own), (a, others))
        )
        made = without_light_left(shaded.albedo_linear.astype(float), *faces)
        shade = np.log(made[b.mask] / b.albedo_linear[b.mask]).mean(-1)
        return np.polyfit(ramp[b.mask], shade, 1)[0]

    assert left(0.3, 0.05) < 0.5
    assert left(0.02, 0.3) > 0.97
    assert_array_equal(without_light_left(b.albedo_linear, b, a), b.albedo_linear)


def test_a_feature_of_little_contrast_is_found_by_its_label():
    """Pale brows show nothing to follow: the marks say where they are."""
    mask, flat = np.ones((256, 256), bool), np.full((256, 256, 3), 0.5)
    row, column = np.indices(mask.shape)
    brow = (row - 96) ** 2 + ((column - 85) / 2) ** 2 < 36
    beside = displacement(flat, flat, mask, [(brow, np.roll(brow, (3, 5), (0, 1)))])
    assert beside[96, 85] == pytest.approx([5, 3], abs=1)
    assert np.abs(beside[200, 200]).max() < 0.5
