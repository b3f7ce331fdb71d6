"""Faces without a common chart are refused with both names and what differs."""

from dataclasses import replace

import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import blend_faces, load_result, swap_texture, transfer_expression
from scan2albedo.errors import ApplicationError
from scan2albedo.unlit.processed_face import on_common_chart

APPLICATIONS = [blend_faces, swap_texture, lambda a, b: transfer_expression(a, a, b)]


@pytest.mark.parametrize("apply", APPLICATIONS)
def test_sizes_models_and_charts_must_agree(person, two_people, apply):
    a, b = two_people
    mirrored = replace(b.mesh, uv=b.mesh.uv * [1, -1] + [0, 1], from_chart=False)
    fitted = replace(a, model_name="none", mesh=replace(a.mesh, from_chart=False))
    for one, other, words in (
        (a, person(1, size=32), r"person0 and person1.*64 x 64 and 32 x 32.*--size"),
        (a, replace(b, model_name="mine"), "different models, 'default annotated face model' and 'mine'"),
        (fitted, replace(b, model_name="none", mesh=mirrored), "without a model"),
        (a, replace(b, mesh=mirrored), "charts differ"),
    ):
        with pytest.raises(ApplicationError, match=words):
            apply(one, other)


def test_a_fitted_face_goes_with_itself_only_by_its_mesh(stored, person):
    face = load_result(stored)
    assert not face.mesh.from_chart
    made = blend_faces(face, face)
    assert_allclose(made.image.position, face.image.position, atol=1e-6)
    assert_allclose(made.image.normal, face.image.normal, atol=1e-6)


def test_masks_that_differ_a_little_are_cut_to_what_both_have(two_people):
    a, b = two_people
    mask = b.mask.copy()
    mask[30:33, 30:33] = False
    image = replace(b.image, mask=mask)
    smaller = replace(b, image=image, mesh=type(b.mesh).of_chart(image))
    cut, other = on_common_chart(a, smaller)
    assert_array_equal(cut.mask, a.mask & mask)
    assert_array_equal(cut.mesh.faces, other.mesh.faces)
    assert not cut.albedo_linear[31, 31].any()
    assert cut.image.region[31, 31] == 255
    for made in (other, blend_faces(a, smaller), swap_texture(a, smaller), swap_texture(smaller, a)):
        assert_array_equal(made.mask, cut.mask)
