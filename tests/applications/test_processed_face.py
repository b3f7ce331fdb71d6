"""Faces without a common chart are refused with both names and what differs."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo.applications import blend_faces, load_result, swap_texture, transfer_expression
from scan2albedo.applications.processed_face import on_common_chart
from scan2albedo.errors import ApplicationError

APPLICATIONS = [blend_faces, swap_texture, lambda a, b: transfer_expression(a, a, b)]


@pytest.mark.parametrize("apply", APPLICATIONS)
def test_sizes_models_and_charts_must_agree(person, apply):
    a, b = person(0), person(1)
    with pytest.raises(ApplicationError, match=r"person0 and person1.*64 x 64 and 32 x 32.*--size"):
        apply(a, person(1, size=32))
    with pytest.raises(ApplicationError, match="different models, 'default annotated face model' and 'mine'"):
        apply(a, replace(b, model_name="mine"))
    with pytest.raises(ApplicationError, match="without a model"):
        apply(
            *(replace(face, model_name="none", mesh=flipped(face.mesh, k)) for k, face in enumerate((a, b)))
        )
    with pytest.raises(ApplicationError, match="charts differ"):
        apply(a, replace(b, mesh=flipped(b.mesh, 1)))


def flipped(mesh, turn):
    """The mesh on a chart that is mirrored."""
    uv = mesh.uv * [1, -1] + [0, 1] if turn else mesh.uv
    return replace(mesh, uv=uv, from_chart=False)


def test_a_fitted_face_goes_with_itself_only_by_its_mesh(stored, person):
    face = load_result(stored)
    assert not face.mesh.from_chart
    made = blend_faces(face, face)
    assert_allclose(made.image.position, face.image.position, atol=1e-6)
    assert_allclose(made.image.normal, face.image.normal, atol=1e-6)


def test_masks_that_differ_a_little_are_cut_to_what_both_have(person):
    a, b = person(0), person(1)
    image, mask = b.image, b.mask.copy()
    mask[30:33, 30:33] = False
    smaller = replace(
        b, image=replace(image, mask=mask), mesh=type(b.mesh).of_chart(replace(image, mask=mask))
    )
    cut, other = on_common_chart(a, smaller)
    assert np.array_equal(cut.mask, a.mask & mask)
    assert np.array_equal(cut.mask, other.mask)
    assert np.array_equal(cut.mesh.faces, other.mesh.faces)
    assert not cut.albedo_linear[31, 31].any()
    assert cut.image.region[31, 31] == 255
    assert blend_faces(a, smaller).mask.sum() == cut.mask.sum()
