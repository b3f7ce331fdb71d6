"""Any object becomes a geometry image through xatlas charts."""

import numpy as np
import pytest
import xatlas
from helpers.meshes import sphere
from numpy.testing import assert_allclose

from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import GeometryImageError
from scan2albedo.sampling import geometry_image_of_scan, geometry_images

BALL = RawScan(*sphere(1, 80.0))


def test_a_sphere_is_covered_once_with_true_positions_and_normals():
    image = geometry_image_of_scan(RawScan(*sphere(4, 80.0, 1000.0)), 256)
    inside = image.mask
    assert inside.mean() > 0.3
    radius = np.linalg.norm(image.position[inside], axis=1)
    assert_allclose(radius, 80, atol=0.4)
    outward = np.einsum("ij,ij->i", image.normal[inside], image.position[inside] / radius[:, None])
    assert outward.min() > 0.99


def test_an_atlas_outlives_its_chart():
    """Its end waits for its threads, for ever where one of them is just going to sleep."""
    kept = []
    for _ in range(2):
        geometry_image_of_scan(BALL, 32)
        kept += geometry_images.LAST_ATLAS
    assert [type(atlas) for atlas in kept] == [xatlas.Atlas] * 2
    assert kept[0] is not kept[1]


def test_holes_that_meet_in_a_vertex_do_not_keep_a_surface_from_being_simplified(monkeypatch):
    vertices, faces = sphere(3, 80.0)
    around = np.flatnonzero((faces == 0).any(axis=1))
    beside = [face for face in around if len(np.intersect1d(faces[face], faces[around[0]])) == 1]
    faces = np.delete(faces, [around[0], beside[0]], axis=0)
    monkeypatch.setattr(geometry_images, "MOST_FACES", 600)
    image = geometry_image_of_scan(RawScan(vertices, faces), 64)
    assert len(image.occluder[1]) <= 600
    assert_allclose(np.linalg.norm(image.position[image.mask], axis=1), 80, atol=2)


def test_colours_come_along():
    vertices, faces = sphere(3, 50.0)
    color = ((vertices + 50) / 100).astype(np.float32)
    image = geometry_image_of_scan(RawScan(vertices, faces, vertex_color_linear=color), 128)
    expected = (image.position[image.mask] + vertices.mean(0) + 50) / 100
    assert image.texture_valid[image.mask].mean() > 0.95
    assert_allclose(image.texture_linear[image.mask], expected, atol=0.02)


def test_too_small_a_size_is_refused():
    with pytest.raises(GeometryImageError, match="size 7 does not suit"):
        geometry_image_of_scan(BALL, 7)
