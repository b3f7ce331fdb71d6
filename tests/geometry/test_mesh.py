"""Elementary mesh quantities against closed forms."""

import itertools

import numpy as np
import pytest
import trimesh
from helpers.face_mask import mask_surface
from helpers.meshes import sphere
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry import mesh
from scan2albedo.geometry.mesh import (
    boundary_vertex_mask,
    face_lists,
    far_faces,
    join,
    neighbour_lists,
    normalized,
    thinned,
    vertex_normals,
)


def test_area_and_normals_of_a_sphere():
    vertices, faces = sphere(4, 10.0)
    area = mesh.face_areas(vertices, faces).sum()
    assert area == pytest.approx(400 * np.pi, rel=0.01)
    assert mesh.vertex_areas(vertices, faces).sum() == pytest.approx(area)
    outward = np.einsum("ij,ij->i", vertex_normals(vertices, faces), vertices / 10)
    assert outward.min() > 0.999


def test_zero_area_faces_and_lone_vertices_have_zero_normals_not_nan():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 9, 9]])
    faces = np.array([[0, 1, 2]])
    assert (mesh.face_normals(vertices, faces) == 0).all()
    assert (vertex_normals(vertices, faces) == 0).all()


def test_boundary_of_an_open_square_and_of_a_closed_box():
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    assert boundary_vertex_mask(5, faces).tolist() == [True, True, True, True, False]
    assert not boundary_vertex_mask(8, np.asarray(trimesh.creation.box().faces)).any()


def test_components_and_unreferenced_vertices():
    faces = np.array([[0, 1, 2], [4, 5, 6]])
    labels = mesh.vertex_components(8, faces)
    assert labels[0] == labels[1] == labels[2] != labels[4]
    assert len(set(labels.tolist())) == 4
    kept, renumbered = mesh.without_unreferenced(np.zeros((8, 3)), faces)
    assert kept.tolist() == [0, 1, 2, 4, 5, 6]
    assert renumbered.tolist() == [[0, 1, 2], [3, 4, 5]]


def rows(begins, values):
    return [values[a:b].tolist() for a, b in itertools.pairwise(begins)]


def fan(count):
    """Faces around vertex 0, in random order: far more neighbours than a vertex usually has."""
    rim = np.random.default_rng(0).permutation(np.arange(1, count))
    return np.stack([np.zeros(count - 1, int), rim, np.roll(rim, 1)], 1)


@pytest.mark.parametrize(
    "faces",
    [
        np.zeros((0, 3), int),
        np.array([[0, 1, 2], [2, 1, 3], [0, 1, 2]]),
        np.array([[4, 4, 4], [1, 1, 3]]),
        np.random.default_rng(1).integers(0, 12, (60, 3)),
        fan(12),
        fan(500),
    ],
)
def test_lists_are_those_of_plain_sets(faces):
    count = max(12, int(faces.max(initial=0)) + 1)
    joined, around = [set() for _ in range(count)], [[] for _ in range(count)]
    for number, face in enumerate(faces.tolist()):
        for corner in face:
            around[corner].append(number)
            joined[corner] |= {*face} - {corner}
    assert rows(*neighbour_lists(count, faces)) == list(map(sorted, joined))
    assert rows(*face_lists(count, faces)) == around


@pytest.mark.parametrize("wrong", [-1, 5])
def test_faces_of_no_vertex_are_refused(wrong):
    for lists in (neighbour_lists, face_lists):
        with pytest.raises(IndexError, match="faces refer to vertices"):
            lists(5, np.array([[0, 1, wrong]]))


@pytest.mark.parametrize("share", [0.01, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("attached", [False, True])
def test_stray_patches_are_found_however_many(share, attached):
    rng = np.random.default_rng(int(100 * share))
    parts, strip = [sphere(4)], np.arange(23)[:, None] + [0, 1, 2]
    count = len(parts[0][0])
    for _ in range(round(share / (1 - share) * count / 25)):
        center = rng.uniform(400, 1300) * normalized(rng.normal(size=3))
        parts.append((rng.normal(scale=8.0, size=(25, 3)) + center, strip))
    vertices, faces = join(parts)
    first = np.arange(count, len(vertices), 25)
    if attached:
        faces = np.concatenate([faces, np.stack([first, first + 1, 0 * first], axis=1)])
    assert_array_equal(far_faces(vertices, faces), (faces >= count).any(1))


def test_a_second_head_and_a_coarse_body_are_not_stray():
    for coarse, away in ((3, (900.0, 0, 0)), (4, (0, 1200.0, 0))):
        assert not far_faces(*join([sphere(4), sphere(coarse, center=away)])).any()


def test_stray_faces_do_not_take_everything_along():
    """Every face may reach to a far vertex: none is stray then."""
    around = np.arange(31)
    vertices = np.stack([np.cos(around), np.sin(around), np.where(around > 0, 0, 500.0)], axis=1)
    assert not far_faces(vertices, fan(31)).any()


def test_a_coarse_surface_stays_as_it_is():
    vertices, faces = mask_surface(20)
    thin = thinned(vertices, faces, 1.0)
    assert len(thin.vertices) == len(vertices)
    assert thin.faces.shape == faces.shape
    assert (thin.count == 1).all()
    assert thin.boundary.sum() == boundary_vertex_mask(len(vertices), faces).sum()


def test_a_dense_surface_keeps_its_place_and_its_border():
    vertices, faces = mask_surface(200)
    thin = thinned(vertices, faces, 4.0)
    assert thin.count.sum() == len(vertices)
    assert len(thin.vertices) < len(vertices) / 5
    flat, even = thin.vertices[:, :2], vertices[:, :2]
    away = np.maximum(np.abs(even).max(0) - np.abs(flat), 0).min(1)
    assert away[thin.boundary].max() < 4.0
    assert not thin.boundary[away > 4.0].any()
    assert (vertex_normals(thin.vertices, thin.faces)[:, 2] > 0).mean() > 0.98


def test_a_cell_of_many_vertices_averages_their_noise_out():
    vertices, faces = mask_surface(300)
    plane = vertices * [1, 1, 0]
    thin = thinned(np.random.default_rng(0).normal(plane, [0, 0, 0.1]), faces, 4.0)
    full = thin.count > 15
    assert full.mean() > 0.5
    assert thin.vertices[full, 2].std() < 0.1 / np.sqrt(12)


@pytest.mark.parametrize("cell_mm", [1e-3, 0.5, 5.0])
def test_seams_close_and_a_closed_surface_has_no_border_however_it_crumples(cell_mm):
    torus = trimesh.creation.torus(40.0, 15.0, major_sections=120, minor_sections=50)
    faces = np.asarray(torus.faces)
    crumpled = torus.vertices + np.random.default_rng(1).normal(scale=0.5, size=torus.vertices.shape)
    soup, separate = crumpled[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    assert boundary_vertex_mask(len(soup), separate).all()
    assert not thinned(soup, separate, cell_mm).boundary.any()


def test_a_surface_within_one_cell_has_no_faces_left():
    vertices, faces = mask_surface(5)
    thin = thinned(vertices * 1e-3, faces, 5.0)
    assert len(thin.vertices) == 1
    assert thin.faces.shape == (0, 3)


def test_a_vertex_far_away_joins_only_its_neighbours():
    vertices = np.array([[0.0, 0, 0], [1e20, 0, 0], [0, 1e20, 0], [0, 1e20, 1.0]])
    thin = thinned(vertices, np.array([[0, 1, 2], [0, 1, 3]]), 2.0)
    assert_array_equal(np.sort(thin.count), [1, 1, 2])
    assert_allclose(np.sort(thin.vertices[:, 0]), [0, 0, 1e20])
