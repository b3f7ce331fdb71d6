"""Blends: the ends are the faces, a face with itself is itself, in between lies between."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from helpers.faces import painted, square, unseen
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import blend_faces, relight
from scan2albedo.applications.face_features import feature_texels, grown
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.synthetic import light_at


def same(made, face, tolerance=1e-6):
    mask = face.mask
    assert_array_equal(made.mask, mask)
    for field in ("position", "normal"):
        assert_allclose(getattr(made.image, field), getattr(face.image, field), atol=tolerance, rtol=0)
    assert_allclose(made.albedo_linear, face.albedo_linear, atol=tolerance, rtol=0)
    assert_allclose(made.mesh.vertices, face.mesh.vertices, atol=tolerance, rtol=0)
    assert astuple(made.reflectance)[1:] == pytest.approx(astuple(face.reflectance)[1:])
    assert made.reflectance.brdf == face.reflectance.brdf
    assert made.lights == face.lights


@pytest.mark.parametrize("weight", [0.0, 0.3, 0.5, 1.0])
def test_a_face_with_itself_is_itself(person, weight):
    same(blend_faces(person(0), person(0), weight), person(0))
    if weight in (0, 1):  # The ends are the faces.
        same(blend_faces(person(0), person(1), weight), person(int(weight)))


@pytest.mark.parametrize("weight", [0.02, 0.5])
def test_a_face_with_itself_keeps_what_was_not_seen(person, weight):
    face = unseen(person(0), square(person(0), (20, 40), (20, 40)))
    same(blend_faces(face, face, weight), face)


def test_the_middle_lies_between(person, two_people):
    a, b = two_people
    made = blend_faces(a, b, 0.25)
    mask = a.mask & b.mask
    expected = 0.75 * a.image.position[mask] + 0.25 * b.image.position[mask]
    assert_allclose(made.image.position[mask], expected, atol=1e-12)
    assert_allclose(np.linalg.norm(made.image.normal[mask], axis=1), 1, atol=1e-12)
    # The level lies between geometrically, whichever scan was exposed longer.
    assert made.level() == pytest.approx(a.level() ** 0.75 * b.level() ** 0.25, rel=0.02)
    again = blend_faces(made, person(2), 0.3)
    assert np.isfinite(relight(again, [light_at(30)]).texture_linear).all()


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
    assert_allclose(blend_faces(a, b, 1.0).albedo_linear, b.albedo_linear, atol=1e-6)
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
    same(blend_faces(a, b, 0.0), a)
    almost = blend_faces(a, b, 1e-4)
    assert_allclose(almost.albedo_linear, a.albedo_linear, atol=0.01)


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
