"""Eyes, brows, nostrils and mouth are of one face or of the other, and carry no reflection of a lamp."""

from dataclasses import replace

import numpy as np

from scan2albedo.applications import blend_faces, swap_texture
from scan2albedo.applications.face_features import chosen_features, feature_texels, without_catchlights


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
    choice = chosen_features(b, a)
    assert choice.taken[eyes].all()
    assert not choice.kept[eyes].any()
    swapped = swap_texture(a, b)
    assert gradient_correlation(swapped, a, eyes) > 0.99
    half_way = blend_faces(a, b, 0.5)
    assert gradient_correlation(half_way, a, eyes) > 0.9
    # All the rest of the features is B's.
    for name, texels in feature_texels(a).items():
        if name != "eyes":
            assert choice.kept[texels].all()


def test_a_feature_that_both_lack_stays_and_so_does_a_small_gap(person):
    (a, eyes), (b, _) = (with_half_of(person(seed), "eyes") for seed in (0, 1))
    choice = chosen_features(b, a)
    np.testing.assert_array_equal(choice.kept[eyes], b.image.seen[eyes])
    np.testing.assert_array_equal(choice.lost[eyes], ~b.image.seen[eyes])
    # Nothing of A's own, and nothing black, is where neither was seen.
    assert swap_texture(a, b).albedo_linear[choice.lost].max(-1).min() > 0.2 * a.level()
    whole = person(1)
    row, column = (at[0] for at in np.nonzero(eyes))
    seen = whole.mask.copy()
    seen[row, column] = False
    nearly = replace(whole, image=replace(whole.image, texture_valid=seen))
    assert chosen_features(nearly, person(0)).kept[eyes].sum() == eyes.sum() - 1
    made = swap_texture(person(0), nearly)
    assert gradient_correlation(made, whole, eyes) > 0.99


def test_no_features_are_known_of_another_models_face(person):
    assert feature_texels(replace(person(0), model_name="of mine")) == {}
    assert not chosen_features(replace(person(0), model_name="of mine"), person(1)).kept.any()


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
