"""Eyes, brows, nostrils and mouth are of one face or of the other, and carry no reflection of a lamp."""

from dataclasses import replace

import numpy as np
from helpers.faces import painted, unseen
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import SwapOptions, blend_faces, swap_texture
from scan2albedo.face_model.materials import CLASSES
from scan2albedo.unlit.face_features import (
    feature_texels,
    grown,
    open_features,
    taken_features,
    texels_of_parts,
    without_catchlights,
)


def with_half_eyes(face):
    """Return a face of which the outer halves of the eyes were not seen, and are black; and its eyes."""
    texels = feature_texels(face)["eyes"]
    outward = np.abs(np.indices(texels.shape)[1] - (texels.shape[1] - 1) / 2)
    outer = texels & (outward > np.median(outward[texels]))
    return unseen(painted(face, outer, 0.001), outer), texels


def gradient_correlation(made, given, texels):
    slopes = [np.diff(np.log(np.maximum(f.albedo_linear.max(-1), 1e-5)), axis=1) for f in (made, given)]
    inner = texels[:, 1:] & texels[:, :-1]
    return np.corrcoef(slopes[0][inner], slopes[1][inner])[0, 1]


def test_half_seen_eyes_are_the_other_faces_as_a_whole(person):
    a, (b, eyes) = person(0), with_half_eyes(person(1))
    taken, kept = taken_features(b, a)
    assert taken[eyes].all()
    assert not kept[eyes].any()
    swapped = swap_texture(a, b)
    assert gradient_correlation(swapped, a, eyes) > 0.99
    half_way = blend_faces(a, b, 0.5)
    assert gradient_correlation(half_way, a, eyes) > 0.9
    # The mouth is B's.
    mouth = feature_texels(a)["mouth"]
    assert kept[mouth].all()
    assert not taken[mouth].any()


def test_a_feature_that_both_lack_stays_and_so_does_a_small_gap(person):
    (a, eyes), (b, _) = (with_half_eyes(person(seed)) for seed in (0, 1))
    assert not taken_features(b, a)[0].any()
    made = swap_texture(a, b, options=SwapOptions(match_level=False))
    assert_allclose(made.albedo_linear[eyes], b.albedo_linear[eyes], rtol=1e-5)
    whole, one = person(1), np.zeros_like(eyes)
    one[tuple(np.argwhere(eyes)[0])] = True
    nearly = unseen(whole, one)
    assert not taken_features(nearly, person(0))[0].any()
    made = swap_texture(person(0), nearly)
    assert gradient_correlation(made, whole, eyes) > 0.99


def test_no_features_are_known_of_another_models_face(person):
    assert feature_texels(replace(person(0), model_name="of mine")) == {}
    assert not taken_features(replace(person(0), model_name="of mine"), person(1))[1].any()


def test_labels_widen_a_feature_and_are_known_of_any_model(person):
    face = person(0)
    eyes = feature_texels(face)["eyes"]
    lower = np.roll(eyes, 3, axis=0) & face.mask
    labels = np.where(lower, CLASSES.index("eye"), CLASSES.index("skin")).astype(np.uint8)
    marked = replace(face, image=replace(face.image, labels=labels))
    assert_array_equal(feature_texels(marked)["eyes"], eyes | lower)
    assert_array_equal(feature_texels(replace(marked, model_name="of mine"))["eyes"], lower)


def test_catchlights_go_and_bright_skin_stays(person):
    face = person(0, size=128)
    eyes = feature_texels(face)["eyes"]
    row, column = (int(np.median(at)) for at in np.nonzero(eyes & (np.arange(128) < 64)))
    albedo = face.albedo_linear.copy()
    albedo[[row, 20], [column, 64]] = 3.0
    made = without_catchlights(replace(face, albedo_linear=albedo))
    assert made[row, column].max() < 1.6 * face.level()
    assert made[20, 64].max() == 3.0
    calm = albedo.max(-1) < face.level()
    assert_allclose(made[calm], albedo[calm], rtol=1e-6)


def test_a_hole_in_a_brow_is_filled_from_the_other_side_of_the_same_face(person):
    a, b = person(0, size=128), person(1, size=128)
    brow = texels_of_parts(b, ["left_brow"])
    hole = brow & (np.arange(128) > np.median(np.nonzero(brow)[1]))
    torn = unseen(painted(b, hole, 0.001), hole)
    dark = painted(a, feature_texels(a)["brows"], 0.2 * a.albedo_linear)
    made, of_dark = (swap_texture(face, torn) for face in (a, dark))
    # Whatever the other face has there changes nothing, and the other side is what comes.
    levels = (face.albedo_linear[hole] / face.level() for face in (of_dark, made))
    assert_allclose(*levels, rtol=0.05)
    assert gradient_correlation(made, replace(b, albedo_linear=b.albedo_linear[:, ::-1]), hole) > 0.9


def with_shut_eyes(face, names=("left_eye", "right_eye")):
    """Return a face whose eyes are painted over with the skin around, as shut lids are."""
    eyes = grown(texels_of_parts(face, names), 0)
    skin = np.median(face.albedo_linear[grown(eyes, 0.02) & ~eyes], axis=0)
    return painted(face, eyes, skin)


def test_open_eyes_stay_whole_beside_shut_ones_and_the_face_says_so(person):
    a, b = person(0, size=128), with_shut_eyes(person(1, size=128))
    assert open_features(a)["eyes"]
    assert not open_features(b)["eyes"]
    eyes = texels_of_parts(a, ["left_eye", "right_eye"])
    assert gradient_correlation(swap_texture(a, b), a, eyes) > 0.99
    for weight, nearer in ((0.4, a), (0.6, b)):
        made = blend_faces(a, b, weight)
        assert made.notes == (
            f"eyes open in one face and shut in the other: those of {nearer.name} as a whole",
        )
        if nearer is a:
            assert gradient_correlation(made, a, eyes) > 0.95
        else:
            inner, plain = (f.albedo_linear[eyes].max(-1) / f.level() for f in (made, a))
            assert np.std(inner) < 0.3 * np.std(plain)
    assert blend_faces(a, person(1, size=128)).notes == ()


def test_a_wide_open_mouth_is_open(person):
    face = person(0, size=256)
    between = texels_of_parts(face, ["between_lips"])
    assert not open_features(face)["mouth"]
    stretched = face.image.position.copy()
    rows = np.cumsum(between, axis=0)
    stretched[..., 1] -= face.mask * 24.0 * rows / np.maximum(rows[-1], 1)
    assert open_features(replace(face, image=replace(face.image, position=stretched)))["mouth"]
