"""Swapped skins: whose shape, whose skin, no seam where a texture was not seen."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.faces import painted, square, unseen
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import SwapOptions, swap_texture
from scan2albedo.applications.texture_swap import trusted
from scan2albedo.unlit.face_features import grown


def test_the_shape_is_as_and_the_skin_bs(two_people):
    a, b = two_people
    made = swap_texture(a, b, options=SwapOptions(match_color=False))
    assert_array_equal(made.image.position, a.image.position)
    assert_array_equal(made.image.normal, a.image.normal)
    assert made.lights == a.lights
    gain = a.level() / b.level()
    assert_allclose(made.albedo_linear[a.mask] / b.albedo_linear[a.mask], gain, rtol=1e-4)
    assert made.reflectance.specular_strength == pytest.approx(b.reflectance.specular_strength * gain)
    assert made.level() == pytest.approx(a.level(), rel=1e-5)
    own_level = swap_texture(a, b, options=SwapOptions(match_level=False))
    assert_allclose(own_level.albedo_linear, b.albedo_linear, rtol=1e-6)


def test_a_face_with_its_own_skin_is_itself_also_where_it_was_not_seen(person):
    for face in (person(0), unseen(person(0), square(person(0), (20, 40), (20, 40)))):
        made = swap_texture(face, face)
        assert_allclose(made.albedo_linear, face.albedo_linear, rtol=1e-6)
        assert made.reflectance == face.reflectance


def with_hole(face, hole):
    return unseen(painted(face, hole, 0.003), hole)


def test_unseen_skin_is_continued_without_a_seam(two_people):
    a, b = two_people
    hole = square(b, (30, 46), (12, 22))
    made = swap_texture(a, with_hole(b, hole), options=SwapOptions(match_level=False))
    known = trusted(with_hole(b, hole))
    assert_allclose(made.albedo_linear[known], b.albedo_linear[known], rtol=1e-6)
    # Nothing of what was badly seen is left, and the step at the border is no larger than steps elsewhere.
    filled = made.albedo_linear[hole & a.mask].max(-1)
    assert filled.min() > 0.05
    step, usual = (np.abs(np.diff(np.log(f.albedo_linear[38, 5:30].max(-1)))).max() for f in (made, b))
    assert step < 2 * usual + 0.1


def test_the_detail_of_the_filling_is_as(two_people):
    a, b = two_people
    hole = square(b, (10, 50), (10, 50))
    made = swap_texture(a, with_hole(b, hole))
    detail = [np.diff(np.log(face.albedo_linear[15:45, 15:45].max(-1))).ravel() for face in (made, a)]
    assert np.corrcoef(detail)[0, 1] > 0.95


def test_a_blurred_skin_is_not_continued_with_a_sharp_ones_grain(person):
    a, b = (replace(person(seed), model_name="of mine") for seed in (0, 1))
    grain = np.exp(np.random.default_rng(0).normal(0, 1, a.mask.shape))[..., None]
    hole = square(b, (20, 44), (20, 44))

    def roughness(weight_a, weight_b):
        mine = painted(a, a.mask, a.albedo_linear * grain**weight_a)
        theirs = painted(b, b.mask, b.albedo_linear * grain**weight_b)
        made = swap_texture(mine, with_hole(theirs, hole))
        return np.median(np.abs(np.diff(np.log(made.albedo_linear[26:38, 26:38].max(-1)))))

    # The other way round a blurred face's filling is all there is.
    assert roughness(0.2, 0.02) < 0.5 * roughness(0.2, 0.2)
    assert roughness(0.02, 0.2) < 1.2 * roughness(0.02, 0.02)


def test_a_feature_of_one_face_at_the_border_leaves_no_stain(person):
    """A dark line of A crosses the border of the hole, which is no known feature; on B there is none."""
    a, b = (replace(person(seed), model_name="of mine") for seed in (0, 1))
    line, hole = square(a, (34, 40), (20, 31)), square(a, (28, 48), (28, 46))
    marked = painted(a, line, 0.1 * a.albedo_linear)
    plain = swap_texture(a, with_hole(b, hole)).albedo_linear
    made = swap_texture(marked, with_hole(b, hole)).albedo_linear / marked.level() * a.level()
    beyond = hole & ~grown(line, 0)  # its edge fades in from the border
    change = np.abs(np.log(made[beyond].max(-1) / plain[beyond].max(-1)))
    assert change.max() < 0.065
    # What of the line lies in the hole stays a line.
    assert (made[36:38, 28:31] < 0.3 * plain[36:38, 28:31]).all()
