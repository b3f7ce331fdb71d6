"""Elementary mesh quantities against closed forms."""

import itertools

import numpy as np
import pytest
import trimesh
from helpers.meshes import sphere

from scan2albedo.geometry import mesh
from scan2albedo.geometry.mesh import face_lists, far_faces, neighbour_lists
from scan2albedo.synthetic.sitter import join


def test_area_and_normals_of_a_sphere():
    vertices, faces = sphere(4, 10.0)
    assert abs(mesh.face_areas(vertices, faces).sum() - 400 * np.pi) < 0.01 * 400 * np.pi
    np.testing.assert_allclose(
        mesh.vertex_areas(vertices, faces).sum(), mesh.face_areas(vertices, faces).sum()
    )
    outward = np.einsum("ij,ij->i", mesh.vertex_normals(vertices, faces), vertices / 10)
    assert outward.min() > 0.999


def test_zero_area_faces_and_lone_vertices_have_zero_normals_not_nan():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 9, 9]])
    faces = np.array([[0, 1, 2]])
    assert (mesh.face_normals(vertices, faces) == 0).all()
    assert (mesh.vertex_normals(vertices, faces) == 0).all()


def test_boundary_of_an_open_square_and_of_a_closed_box():
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    assert mesh.boundary_vertex_mask(5, faces).tolist() == [True, True, True, True, False]
    assert not mesh.boundary_vertex_mask(8, np.asarray(trimesh.creation.box().faces)).any()


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
    ids=["none", "twice the same", "degenerate", "random", "fan", "large fan"],
)
def test_lists_are_those_of_plain_sets(faces):
    count = max(12, int(faces.max(initial=0)) + 1)
    joined, around = [set() for _ in range(count)], [[] for _ in range(count)]
    for number, face in enumerate(faces.tolist()):
        for k in range(3):
            around[face[k]].append(number)
            joined[face[k]] |= set(face) - {face[k]}
    assert rows(*neighbour_lists(count, faces)) == [sorted(one) for one in joined]
    assert rows(*face_lists(count, faces)) == around


@pytest.mark.parametrize("wrong", [-1, 5])
def test_faces_of_no_vertex_are_refused(wrong):
    for lists in (neighbour_lists, face_lists):
        with pytest.raises(IndexError, match="faces refer to vertices"):
            lists(5, np.array([[0, 1, wrong]]))


def patch(count, center, rng):
    """Return vertices and faces of a crumpled strip."""
    index = np.arange(count - 2)[:, None] + [0, 1, 2]
    return rng.normal(scale=8.0, size=(count, 3)) + center, index


@pytest.mark.parametrize("share", [0.01, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("attached", [False, True])
def test_stray_patches_are_found_however_many(share, attached):
    rng = np.random.default_rng(int(100 * share))
    parts = [sphere(4)]
    count = len(parts[0][0])
    for _ in range(round(share / (1 - share) * count / 25)):
        away = rng.normal(size=3)
        parts.append(patch(25, away / np.linalg.norm(away) * rng.uniform(400, 1300), rng))
    vertices, faces = join(parts)
    first = np.arange(count, len(vertices), 25)
    if attached:
        faces = np.concatenate([faces, np.stack([first, first + 1, 0 * first], axis=1)])
    far = far_faces(vertices, faces)
    np.testing.assert_array_equal(far, (faces >= count).any(1))


def test_a_second_head_and_a_coarse_body_are_not_stray():
    for coarse, away in ((3, (900.0, 0, 0)), (4, (0, 1200.0, 0))):
        assert not far_faces(*join([sphere(4), sphere(coarse, center=away)])).any()


def test_stray_faces_do_not_take_everything_along():
    """Every face may reach to a far vertex: none is stray then."""
    rim = np.stack([np.cos(np.arange(30)), np.sin(np.arange(30)), 0 * np.arange(30)], axis=1)
    vertices = np.concatenate([rim, [[0, 0, 500.0]]])
    faces = np.stack([np.arange(30), (np.arange(30) + 1) % 30, np.full(30, 30)], axis=1)
    assert not far_faces(vertices, faces).any()
