"""Eyes, brows, nostrils and mouth are of one face or of the other, and carry no reflection of a lamp."""

from dataclasses import replace

import numpy as np

from scan2albedo.applications import SwapOptions, blend_faces, swap_texture
from scan2albedo.applications.face_features import feature_texels, taken_features, without_catchlights
from scan2albedo.face_model.appearance import CLASSES


def with_half_of(face, feature):
    """Return a face of which one half of a feature was not seen, and black."""
    texels = feature_texels(face)[feature]
    unseen = texels.copy()
    unseen[:, : int(np.median(np.nonzero(texels)[1]))] = False
    albedo = np.where(unseen[..., None], 0.001, face.albedo_linear)
    return replace(
        face, albedo_linear=albedo, image=replace(face.image, texture_valid=face.mask & ~unseen)
    ), texels


def gradient_correlation(made, given, texels):
    slopes = [np.diff(np.log(np.maximum(f.albedo_linear.max(-1), 1e-5)), axis=1) for f in (made, given)]
    inner = texels[:, 1:] & texels[:, :-1]
    return np.corrcoef(slopes[0][inner], slopes[1][inner])[0, 1]


def test_half_seen_eyes_are_the_other_faces_as_a_whole(person):
    a, (b, eyes) = person(0), with_half_of(person(1), "eyes")
    taken, kept = taken_features(b, a)
    assert taken[eyes].all()
    assert not kept[eyes].any()
    swapped = swap_texture(a, b)
    assert gradient_correlation(swapped, a, eyes) > 0.99
    half_way = blend_faces(a, b, 0.5)
    assert gradient_correlation(half_way, a, eyes) > 0.9
    # All the rest of the features is B's.
    for name, texels in feature_texels(a).items():
        if name == "mouth":
            assert kept[texels].all()
            assert not taken[texels].any()


def test_a_feature_that_both_lack_stays_and_so_does_a_small_gap(person):
    (a, eyes), (b, _) = (with_half_of(person(seed), "eyes") for seed in (0, 1))
    assert not taken_features(b, a)[0].any()
    made = swap_texture(a, b, options=SwapOptions(match_level=False))
    np.testing.assert_allclose(made.albedo_linear[eyes], b.albedo_linear[eyes], rtol=1e-5)
    whole = person(1)
    row, column = (at[0] for at in np.nonzero(eyes))
    seen = whole.mask.copy()
    seen[row, column] = False
    nearly = replace(whole, image=replace(whole.image, texture_valid=seen))
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
    np.testing.assert_array_equal(feature_texels(marked)["eyes"], eyes | lower)
    np.testing.assert_array_equal(feature_texels(replace(marked, model_name="of mine"))["eyes"], lower)


def test_catchlights_go_and_bright_skin_stays(person):
    face = person(0, size=128)
    eyes = feature_texels(face)["eyes"]
    row, column = (int(np.median(at)) for at in np.nonzero(eyes & (np.arange(128) < 64)))
    albedo = face.albedo_linear.copy()
    albedo[row, column] = 3.0
    albedo[20, 64] = 3.0
    made = without_catchlights(replace(face, albedo_linear=albedo))
    assert made[row, column].max() < 1.6 * face.level()
    assert made[20, 64].max() == 3.0
    calm = albedo.max(-1) < face.level()
    np.testing.assert_allclose(made[calm], albedo[calm], rtol=1e-6)
