"""Unseen and dark places become skin like that beside them; eyes, lips and beards stay."""

from dataclasses import replace

import numpy as np
from helpers.faces import painted, square, unseen
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import RelightOptions, relight
from scan2albedo.face_model.materials import CLASSES
from scan2albedo.synthetic import light_at
from scan2albedo.unlit.face_features import (
    JAWS,
    dark_sides,
    feature_texels,
    grown,
    texels_of_parts,
    without_gaps,
)


def with_sideburns(face):
    """Return a face with black hair along the middle of its left rim, and where that is."""
    rim = np.argmax(face.mask, axis=1)[:, None]
    rows, columns = np.indices(face.mask.shape)
    hair = (rows >= 24) & (rows < 34) & (columns >= rim) & (columns < rim + 5)
    dark = painted(face, hair, 0.02 * face.albedo_linear)
    return replace(dark, image=with_labels(face.image, hair=hair)), hair


def with_labels(image, **things):
    """Return an image whose mask is skin but for the texels of some things."""
    labels = np.where(image.mask, CLASSES.index("skin"), 0)
    for name, texels in things.items():
        labels[texels & image.mask] = CLASSES.index(name)
    return replace(image, labels=labels.astype(np.uint8))


def test_a_black_side_is_filled_from_beside_it(person):
    face, hair = with_sideburns(person(0))
    assert dark_sides(face)[hair].all()
    made = without_gaps(face)
    true = person(0).albedo_linear[hair].max(-1)
    assert np.abs(np.log(made.albedo_linear[hair].max(-1) / true)).mean() < 0.3
    far = ~dark_sides(face)
    assert_array_equal(made.albedo_linear[far], face.albedo_linear[far])


def test_a_dark_place_away_from_the_rim_stays(person):
    face = person(0)
    mole = square(face, (36, 40), (14, 17))
    dark = painted(face, mole, 0.02 * face.albedo_linear)
    marked = replace(dark, image=with_labels(face.image, hair=mole))
    assert without_gaps(marked) is marked


def test_a_beard_stays_and_a_sideburn_alone_does_not(person):
    face, sideburns = with_sideburns(person(0))
    jaws = texels_of_parts(face, JAWS)
    beard = jaws | (sideburns & face.mask) | texels_of_parts(face, ("left_cheek", "right_cheek"))
    # Hair that goes on as beard down to the edge of the jaw.
    mixed = sideburns | square(face, (34, None), (0, 12)) & face.mask & ~jaws
    mixed |= grown(mixed, 0) & jaws & square(face, (0, None), (0, 12))
    hair = sideburns & square(face, (0, 29), (0, None))
    for texels, goes in ((beard, False), (sideburns, True), (mixed, True)):
        things = {"beard": texels} | ({"hair": hair} if texels is mixed else {})
        made = replace(face, image=with_labels(face.image, **things))
        assert dark_sides(made)[sideburns & face.mask].all() == goes
        assert dark_sides(made).any() == goes


def test_without_labels_nothing_is_hair_and_the_annotation_knows_features(person):
    face = with_sideburns(person(0))[0]
    bare = replace(face, image=replace(face.image, labels=None))
    assert not dark_sides(bare).any()
    assert set(feature_texels(bare)) == {"eyes", "brows", "nostrils", "mouth"}


def test_unseen_skin_is_filled_and_unseen_eyes_stay(person):
    face = person(0)
    eyes, hidden = feature_texels(face)["eyes"], square(face, (40, 46), (12, 20))
    made = without_gaps(unseen(painted(face, hidden | eyes, 1e-4), hidden | eyes))
    assert made.albedo_linear[hidden].max(-1).min() > 0.3 * face.level()
    assert_allclose(made.albedo_linear[eyes], 1e-4)


def test_relighting_tells_what_it_filled_and_can_leave_it(person):
    face, hair = with_sideburns(person(0))
    filled = relight(face, [light_at(0)])
    kept = relight(face, [light_at(0)], options=RelightOptions(fill_gaps=False))
    assert filled.texture_linear[hair].mean() > 5 * kept.texture_linear[hair].mean()
    assert "filled" in filled.notes[0]
    assert kept.notes == ()
