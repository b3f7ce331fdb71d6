"""Meshes and textures of the page, against what they were made of."""

import base64
import io

import numpy as np
import pytest
from helpers.meshes import sphere
from numpy.testing import assert_array_equal
from PIL import Image

from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.geometry.mesh import face_areas, face_normals, normalized
from scan2albedo.io.color import decode_srgb_integers
from scan2albedo.report.html.encoding import (
    gray_entry,
    mesh_entry,
    octahedral,
    patch_entry,
    texture_entry,
    thinned_chart,
)
from scan2albedo.unlit.processed_face import FaceMesh


def numbers(text, dtype, columns):
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, columns).astype(float)


def pixels(entry):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(entry["data"]))))


def sheet(size):
    """A square of 1 mm texels over the plane."""
    y, x = np.mgrid[0:size, 0:size].astype(float)
    normal = np.tile([0.0, 0, 1], (size, size, 1))
    return GeometryImage(np.stack([x, -y, 0 * x], -1), normal, np.ones((size, size), bool))


def faces_up(mesh_vertices, faces):
    return (face_normals(mesh_vertices, faces)[:, 2] > 0).all()


def test_meshes_survive_16_bits():
    vertices, faces = sphere(3)
    mesh = FaceMesh(vertices + 40, faces, (vertices[:, :2] + 90) / 180)
    topologies = {}
    entry = mesh_entry(mesh, topologies)
    place = numbers(entry["positions"], "<u2", 3) / 65535 * entry["span"] + entry["low"]
    assert np.abs(place - mesh.vertices).max() <= 180 / 65535 / 2 + 1e-9
    kept = topologies[entry["topology"]]
    assert_array_equal(numbers(kept["faces"], "<u2", 3), mesh.faces)
    assert np.abs(numbers(kept["uv"], "<u2", 2) / 65535 - mesh.uv).max() < 1e-5
    # The same triangles again are kept once.
    assert mesh_entry(mesh, topologies)["topology"] == entry["topology"]
    assert len(topologies) == 1


def test_octahedral_normals_are_off_by_5_thousandths_of_a_degree_at_most():
    normals = np.random.default_rng(0).normal(size=(5000, 3))
    normals[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    normals = normalized(normals)
    e = octahedral(normals) / 32767
    back = np.column_stack([e, 1 - np.abs(e).sum(1)])
    under = back[:, 2] < 0
    back[under, :2] = ((1 - np.abs(back[:, 1::-1])) * np.where(back[:, :2] >= 0, 1, -1))[under]
    assert np.degrees(np.linalg.norm(normalized(back) - normals, axis=1)).max() < 0.005


@pytest.mark.parametrize("most", [800, 300])
def test_a_thinned_chart_covers_what_the_chart_covers(most):
    image = sheet(49)
    row, column = np.mgrid[0:49, 0:49]
    mask = (row - 24) ** 2 + (column - 24) ** 2 < 500
    mask[:, 20] = False  # a seam
    image = GeometryImage(image.position, image.normal, mask)
    full, thin = FaceMesh.of_chart(image), thinned_chart(image, most)
    area = [face_areas(m.vertices, m.faces).sum() for m in (full, thin)]
    assert area[1] == pytest.approx(area[0])
    assert len(thin.vertices) < 0.75 * len(full.vertices)
    assert faces_up(thin.vertices, thin.faces)


def test_a_mirrored_chart_faces_the_way_of_its_normals():
    image = sheet(12)
    position, mask = image.position.copy(), image.mask.copy()
    mask[:, 5] = False
    position[:, 6:, 0] = 40 - position[:, 6:, 0]
    assert faces_up(*GeometryImage(position, image.normal, mask).triangulated())


def test_textures_hold_the_linear_values_to_8_bits_of_srgb():
    rng = np.random.default_rng(1)
    linear, mask = rng.uniform(0.001, 0.2, (40, 30, 3)).astype(np.float32), np.ones((40, 30), bool)
    entry = texture_entry(linear, mask, 64)
    back = decode_srgb_integers(pixels(entry)) / entry["factor"]
    # Half a step is 0.0045 of white at most; the brightest 0.1 % of the texels is clipped.
    assert np.abs(back - linear).max() < 0.005 * 0.2
    small = texture_entry(linear, mask, 10, quality=90)
    assert pixels(small).shape == (10, 8, 3)
    assert small["type"] == "image/jpeg"


def test_textures_are_carried_on_beyond_the_mask_and_may_be_black():
    linear, mask = np.zeros((8, 8, 3)), np.zeros((8, 8), bool)
    mask[:, :4] = True
    linear[:, :4] = 0.5
    assert (pixels(texture_entry(linear, mask, 8)) == 255).all()
    black = texture_entry(np.zeros((8, 8, 3)), mask, 8)
    assert black["factor"] == 1.0
    assert (pixels(black) == 0).all()
    gloss = gray_entry(np.where(mask, 2.0, 0.0), mask, 8)
    assert gloss["scale"] == 2.0
    assert (pixels(gloss) == 255).all()


def test_a_patch_holds_what_differs_alone_also_beyond_the_mask():
    under, mask = np.full((8, 8, 3), 0.5), np.zeros((8, 8), bool)
    mask[:, 2:] = True
    over = under.copy()
    over[3, 2:4] = 0.25
    patch = pixels(patch_entry(over, under, mask, 8, 2.0))
    whole = pixels(texture_entry(over, mask, 8, factor=2.0))
    assert (patch[3, :4, 3] == 255).all()
    assert_array_equal(patch[3, :4, :3], whole[3, :4])
    assert np.count_nonzero(patch[..., 3]) == 4
