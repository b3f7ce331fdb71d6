"""Any object becomes a geometry image through xatlas charts."""

import numpy as np
import pytest
import xatlas
from helpers.measures import row_lengths
from helpers.meshes import ball, sphere
from numpy.testing import assert_allclose

from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import GeometryImageError
from scan2albedo.sampling import geometry_image_of_scan, geometry_images


def test_a_sphere_is_covered_once_with_true_positions_and_normals():
    image = geometry_image_of_scan(RawScan(*sphere(4, 80.0, 1000.0)), 256)
    inside = image.mask
    assert inside.mean() > 0.3
    radius = row_lengths(image.position[inside])
    assert_allclose(radius, 80, atol=0.4)
    outward = np.einsum("ij,ij->i", image.normal[inside], image.position[inside] / radius[:, None])
    assert outward.min() > 0.99


def test_an_atlas_outlives_its_chart():
    """Its end waits for its threads, for ever where one of them is just going to sleep."""
    kept = []
    for _ in range(2):
        geometry_image_of_scan(ball(1), 32)
        kept += geometry_images.LAST_ATLAS
    assert [type(atlas) for atlas in kept] == [xatlas.Atlas] * 2
    assert kept[0] is not kept[1]


@pytest.mark.slow
def test_a_large_surface_is_simplified_first():
    image = geometry_image_of_scan(RawScan(*sphere(6, 80.0)), 128)
    assert len(image.occluder[1]) <= 15_000
    assert_allclose(row_lengths(image.position[image.mask]), 80, atol=0.5)


def test_holes_that_meet_in_a_vertex_do_not_keep_a_surface_from_being_simplified(monkeypatch):
    vertices, faces = sphere(3, 80.0)
    first, *others = np.flatnonzero((faces == 0).any(axis=1))
    opposite = next(face for face in others if len(np.intersect1d(faces[face], faces[first])) == 1)
    faces = np.delete(faces, [first, opposite], axis=0)
    monkeypatch.setattr(geometry_images, "MOST_FACES", 600)
    image = geometry_image_of_scan(RawScan(vertices, faces), 64)
    assert len(image.occluder[1]) <= 600
    assert_allclose(row_lengths(image.position[image.mask]), 80, atol=2)


def test_colours_come_along():
    image = geometry_image_of_scan(ball(3, 50.0), 128)
    expected = image.position[image.mask] / 110 + 0.5
    assert image.texture_valid[image.mask].mean() > 0.95
    assert_allclose(image.texture_linear[image.mask], expected, atol=0.02)


def test_too_small_a_size_is_refused():
    with pytest.raises(GeometryImageError, match="size 7 does not suit"):
        geometry_image_of_scan(ball(1), 7)
