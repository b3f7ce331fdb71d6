"""Meshes and key points that break other solvers: an answer, or an error that names the cause."""

import numpy as np
import pytest
from helpers.meshes import grid
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import bounded_biharmonic_weights, solve_weights
from scan2albedo.geometry.mesh import join

SPACING = 3.0


@pytest.fixture(scope="module")
def plain(glasses):
    return bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.handles, SPACING)


def weights_of(vertices, faces, handles, spacing=SPACING):
    weights = bounded_biharmonic_weights(vertices, faces, handles, spacing)
    assert np.abs(weights.sum(1) - 1).max() <= 1e-12
    return weights


def with_part(glasses, vertices, faces):
    """The glasses with one more part."""
    return join([(glasses.vertices, glasses.faces), (vertices, faces)])


def test_key_points_too_close_for_the_spacing_share_a_handle(glasses, plain):
    handles = np.vstack([glasses.handles, glasses.handles[3] + [2, 0, 0]])
    vertices = np.vstack([glasses.vertices, handles[[3, 7]]])
    found = solve_weights(vertices, glasses.faces, handles, SPACING)
    (step,) = found.plan.of_stage("eyeglasses.weights.shared_handles")
    assert step.ran
    assert "3 and 7" in step.reason
    assert np.abs(found.weights.sum(1) - 1).max() <= 1e-12
    assert found.weights[-2, 3] > 0.95
    assert found.weights[-1, 7] > 0.95
    assert found.weights[-2, 7] == found.weights[-1, 3] == 0
    together = found.weights[:-2, [3]] + found.weights[:-2, [7]]
    others = np.hstack([found.weights[:-2, :3], together, found.weights[:-2, 4:7]])
    assert np.abs(others - plain).max() < 0.1
    assert found.residual.shape == (8,)


def test_key_points_near_the_mesh_hold_it(glasses, plain):
    """Five millimetres above the tube's axis, three above its skin."""
    weights = weights_of(glasses.vertices, glasses.faces, glasses.handles + [0, 5, 0])
    assert weights.max(0).min() > 0.9
    assert np.abs(weights - plain).mean() < 0.03


def test_misuse_is_named(glasses):
    def refused(kind, words, **changes):
        with pytest.raises(kind, match=words):
            bounded_biharmonic_weights(**{**vars(glasses), **changes})

    for bad in (np.nan, np.inf):
        for name, index in (("vertices", (17, 1)), ("handles", (3, 0))):
            values = getattr(glasses, name).copy()
            values[index] = bad
            words = rf"{name}: 1 values .* first at \[{index[0]}, {index[1]}\]"
            refused(EyeglassesError, words, **{name: values})
    refused(ValueError, r"handles is \(3,\), expected \(N, 3\)", handles=[1.0, 2.0, 3.0])
    refused(ValueError, "its faces refer to vertices", faces=glasses.faces + 1)
    refused(ValueError, r"faces is float64 .* expected int", faces=glasses.faces.astype(float))
    for spacing in (0.0, -1.0, np.nan, "fine"):
        refused(ValueError, "spacing must be", spacing=spacing)


def test_inverted_duplicate_and_flat_faces_change_nothing(glasses, plain):
    rng = np.random.default_rng(0)
    faces = np.where(rng.random((len(glasses.faces), 1)) < 0.5, glasses.faces[:, ::-1], glasses.faces)
    flat = np.column_stack([faces[::9, 0], faces[::9, 1], faces[::9, 0]])
    weights = weights_of(glasses.vertices, np.vstack([faces, faces[::5], flat]), glasses.handles)
    assert np.abs(weights - plain).max() <= 1e-9


def test_torn_faces_and_holes(glasses, plain):
    faces = glasses.faces[np.random.default_rng(1).random(len(glasses.faces)) > 0.2]
    weights = weights_of(glasses.vertices, faces, glasses.handles)
    assert np.abs(weights - plain).mean() < 0.02


def test_every_face_a_part_of_its_own(glasses, plain):
    corners = glasses.faces.ravel()
    soup = weights_of(glasses.vertices[corners], np.arange(len(corners)).reshape(-1, 3), glasses.handles)
    assert np.abs(soup - plain[corners]).max() <= 1e-9


def test_unreferenced_vertices_do_not_move_the_lattice(glasses, plain):
    strays = np.array([[1e5, 0, 0], [0, 0, 0], [-70, 1, -118]])
    weights = weights_of(np.vstack([glasses.vertices, strays]), glasses.faces, glasses.handles)
    assert_array_equal(weights[: len(plain)], plain)
    assert weights[-1, 0] > 0.9


def test_a_part_within_reach_is_bridged(tube, glasses, plain):
    """A nose pad 4 mm off the front, with no key point of its own, follows the front beside it."""
    pad, faces = tube([[-12, 0, 8], [12, 0, 8]], radius=1.5, sides=6)
    whole, of_pad = np.split(weights_of(*with_part(glasses, pad, faces), glasses.handles), [len(plain)])
    assert of_pad[:, 3].min() > 0.5
    assert np.abs(whole - plain).max() < 0.1


@pytest.mark.parametrize("distance", [60.0, 1e4])
def test_a_floater_moves_in_one_piece_and_disturbs_nothing(tube, glasses, plain, distance):
    dust, faces = tube([[-70, distance, -118], [-60, distance, -118]], radius=1.5, sides=6)
    found = solve_weights(*with_part(glasses, dust, faces), glasses.handles, SPACING)
    whole, own = np.split(found.weights, [len(plain)])
    assert_allclose(whole, plain, atol=1e-12)
    assert np.abs(own - own[0]).max() == 0
    assert own[0, 0] > 0.5
    assert found.plan[1].evidence == f"1 parts, {len(dust)} vertices"


def test_many_floaters(glasses):
    rng = np.random.default_rng(0)
    dust = np.repeat(rng.uniform(-300, 300, (400, 1, 3)), 3, 1) + rng.normal(0, 1, (400, 3, 3))
    vertices, faces = with_part(glasses, dust.reshape(-1, 3), np.arange(1200).reshape(-1, 3))
    for spacing in (SPACING, "auto"):
        weights_of(vertices, faces, glasses.handles, spacing)


def test_parts_closer_than_the_spacing_become_one(tube, glasses):
    """Two temples 1 mm apart, one without a key point: it goes where the other goes."""
    rod, faces = tube([[0, 0, 0], [0, 0, 60]])
    both = join([(rod, faces), (rod + [5, 0, 0], faces)])
    one, other = np.split(weights_of(*both, [[0, 0, 2], [0, 0, 58]]), 2)
    assert np.abs(one - other).max() < 0.25


def test_parts_out_of_reach_with_key_points_of_their_own(tube, glasses):
    """A pair whose temples lie in the box beside it: each part follows its own key points alone."""
    rod = tube([[0, 200, 0], [0, 200, 60]])
    weights = weights_of(*with_part(glasses, *rod), np.vstack([glasses.handles, [[0, 200, 5], [0, 200, 55]]]))
    whole, of_rod = np.split(weights, [len(glasses.vertices)])
    assert of_rod[:, :7].max() == whole[:, 7:].max() == 0


def test_a_mesh_far_larger_than_its_key_points_is_refused():
    sheet, faces = grid(9, 9)
    with pytest.raises(EyeglassesError, match="no lattice of 10000 nodes"):
        bounded_biharmonic_weights(1e4 * sheet, faces, [[1.0, 1.0, 0.0], [3.0, 1.0, 0.0]])
