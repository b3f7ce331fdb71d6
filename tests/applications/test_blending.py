"""Blends: the ends are the faces, a face with itself is itself, in between lies between."""

from dataclasses import asdict, replace
from operator import attrgetter

import numpy as np
import pytest
from helpers.faces import painted, square, unseen
from helpers.measures import row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import blend_faces
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.unlit.face_features import feature_texels, grown

ARRAYS = attrgetter("image.position", "image.normal", "albedo_linear", "mesh.vertices")
"""What is the same in two faces that look the same."""


def assert_same(made, face):
    assert_array_equal(made.mask, face.mask)
    for found, expected in zip(ARRAYS(made), ARRAYS(face), strict=True):
        assert_allclose(found, expected, atol=1e-6, rtol=0)
    assert asdict(made.reflectance) == pytest.approx(asdict(face.reflectance))
    assert made.lights == face.lights


@pytest.mark.parametrize("weight", [0.0, 0.02, 0.3, 0.5, 1.0])
def test_a_face_with_itself_is_itself_also_where_it_was_not_seen(person, weight):
    for face in (person(0), unseen(person(0), square(person(0), (20, 40), (20, 40)))):
        assert_same(blend_faces(face, face, weight), face)


def test_the_ends_are_the_faces_and_the_middle_lies_between(two_people):
    for weight, face in enumerate(two_people):
        assert_same(blend_faces(*two_people, weight), face)
    a, b = two_people
    made = blend_faces(a, b, 0.25)
    mask = a.mask & b.mask
    expected = 0.75 * a.image.position[mask] + 0.25 * b.image.position[mask]
    assert_allclose(made.image.position[mask], expected, atol=1e-12)
    assert_allclose(row_lengths(made.image.normal[mask]), 1, atol=1e-12)
    # The level lies between geometrically, whichever scan was exposed longer.
    assert made.level() == pytest.approx(a.level() ** 0.75 * b.level() ** 0.25, rel=0.02)


def test_exposure_has_no_say(two_people):
    a, b = two_people
    glossy = replace(b.reflectance, specular_strength=4 * b.reflectance.specular_strength)
    brighter = replace(b, albedo_linear=4 * b.albedo_linear, reflectance=glossy)
    plain, other = blend_faces(a, b, 0.5), blend_faces(a, brighter, 0.5)
    # Twice the level: the geometric mean of 1 and 4.
    assert_allclose(other.albedo_linear, 2 * plain.albedo_linear, rtol=1e-5)
    assert other.reflectance.specular_strength == pytest.approx(2 * plain.reflectance.specular_strength)


def test_normals_are_those_of_the_new_surface(person):
    made = blend_faces(person(0), person(1), 0.5)
    inner = made.mask & ~made.image.border
    own = np.zeros_like(made.image.normal)
    own[made.mask] = normalized(made.mesh.on_chart(made.mesh.normals, made.mask))
    cosine = np.einsum("ijk,ijk->ij", own, made.image.normal)[inner]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 3


def test_an_unseen_texture_takes_the_other_ones(person):
    a, hidden = person(0), square(person(0), (20, 40), (20, 40))
    b = unseen(painted(person(1), hidden, 1e-4), hidden)
    made = blend_faces(a, b, 0.5)
    middle = (slice(24, 36), slice(24, 36))
    ratio = made.albedo_linear[middle] / a.albedo_linear[middle]
    assert 0.9 < np.median(ratio) / (made.level() / a.level()) < 1.1
    steps = np.abs(np.diff(np.log(made.albedo_linear[30, 8:56].max(-1))))
    assert steps.max() < 0.7


def test_what_neither_saw_is_skin_in_a_blend_and_its_own_at_the_ends(person):
    """Hair over both temples: dark texels that neither face saw."""
    hair = square(person(0), (8, 32), (0, 14)) | square(person(0), (8, 32), (-14, None))
    hair &= ~grown(feature_texels(person(0))["eyes"], 0.05)
    a, b = (unseen(painted(f, hair, 0.01 * f.albedo_linear), hair) for f in (person(0), person(1)))
    temple = hair & a.mask & b.mask
    for weight in (0.1, 0.5, 0.9):
        made = blend_faces(a, b, weight)
        assert made.albedo_linear[temple].max(-1).min() > 0.4 * made.level()
    assert_same(blend_faces(a, b, 0.0), a)
    assert_allclose(blend_faces(a, b, 1e-4).albedo_linear, a.albedo_linear, atol=0.01)


def test_reflectances_blend_or_the_nearer_one_wins(person):
    def blended(one, other, weight):
        faces = (replace(person(seed), reflectance=r) for seed, r in enumerate((one, other)))
        return blend_faces(*faces, weight).reflectance

    lambert, rough = Reflectance("lambert"), Reflectance("oren-nayar", 0.4, 0.0, 30.0)
    assert blended(lambert, rough, 0.25).roughness == pytest.approx(0.1)
    odd = Reflectance("minnaert", 1.2)
    assert blended(lambert, odd, 0.25).brdf == "lambert"
    assert blended(lambert, odd, 0.75).brdf == "minnaert"
    assert blended(lambert, lambert, 0.25).brdf == "lambert"
    matte, glossy = Reflectance("oren-nayar"), Reflectance("oren-nayar", 0.0, 0.2, 40.0)
    assert blended(matte, glossy, 0.5).exponent == 40.0
    assert blended(matte, glossy, 0.0) == matte


@pytest.mark.parametrize("weight", [-0.1, 1.0001, np.nan, np.inf])
def test_weights_are_parts(person, weight):
    with pytest.raises(ApplicationError, match="weight is"):
        blend_faces(person(0), person(1), weight)
