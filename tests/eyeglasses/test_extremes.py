"""Meshes and key points that break other solvers: an answer, or an error that names the cause."""

import numpy as np
import pytest
from helpers.meshes import grid
from helpers.rods import rod
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import bounded_biharmonic_weights, solve_weights
from scan2albedo.geometry.mesh import join

SPACING = 3.0


@pytest.fixture(scope="module")
def plain(solved):
    return solved.weights


def weights_of(vertices, faces, handles):
    weights = bounded_biharmonic_weights(vertices, faces, handles, SPACING)
    assert np.abs(weights.sum(1) - 1).max() <= 1e-12
    return weights


def with_part(glasses, part):
    """The glasses with one more part."""
    return join([(glasses.vertices, glasses.faces), part])


def test_key_points_too_close_for_the_spacing_share_a_handle(glasses, plain):
    handles = np.vstack([glasses.handles, glasses.handles[3] + [2, 0, 0]])
    vertices = np.vstack([glasses.vertices, handles[[3, 7]]])
    found = solve_weights(vertices, glasses.faces, handles, SPACING)
    (step,) = found.plan.of_stage("eyeglasses.weights.shared_handles")
    assert step.ran
    assert "3 and 7" in step.reason
    assert np.abs(found.weights.sum(1) - 1).max() <= 1e-12
    shares = found.weights[-2:, [3, 7]]
    assert np.diag(shares).min() > 0.95
    assert_array_equal(shares > 0, np.eye(2))
    together = found.weights[:-2, :7].copy()
    together[:, 3] += found.weights[:-2, 7]
    assert np.abs(together - plain).max() < 0.1


def test_key_points_near_the_mesh_hold_it(glasses, plain):
    """Five millimetres above the rod's axis, three above its skin."""
    weights = weights_of(glasses.vertices, glasses.faces, glasses.handles + [0, 5, 0])
    assert weights.max(0).min() > 0.9
    assert np.abs(weights - plain).mean() < 0.03


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"vertices": np.full((3, 3), np.nan)}, EyeglassesError, r"vertices: 9 values .* first at \[0, 0\]"),
        ({"handles": [[0, 0, np.inf]]}, EyeglassesError, r"handles: 1 values .* first at \[0, 2\]"),
        ({"handles": [1.0, 2.0, 3.0]}, ValueError, r"handles is \(3,\), expected \(N, 3\)"),
        ({"faces": [[0, 1, 10**6]]}, ValueError, "its faces refer to vertices"),
        ({"faces": [[0.0, 1, 2]]}, ValueError, r"faces is float64 .* expected int"),
        *(({"spacing": bad}, ValueError, "spacing must be") for bad in (0.0, -1.0, np.nan, "fine")),
    ],
)
def test_misuse_is_named(glasses, changes, kind, words):
    with pytest.raises(kind, match=words):
        bounded_biharmonic_weights(**{**vars(glasses), **changes})


def test_inverted_repeated_and_separate_faces_change_nothing(glasses, plain):
    faces = np.vstack([glasses.faces[::2, ::-1], glasses.faces[1::2], glasses.faces[::5]])
    corners = faces.ravel()
    separate = np.arange(len(corners)).reshape(-1, 3)
    weights = weights_of(glasses.vertices[corners], separate, glasses.handles)
    assert np.abs(weights - plain[corners]).max() <= 1e-9


def test_torn_faces_and_holes(glasses, plain):
    faces = glasses.faces[np.random.default_rng(1).random(len(glasses.faces)) > 0.2]
    weights = weights_of(glasses.vertices, faces, glasses.handles)
    assert np.abs(weights - plain).mean() < 0.02


def test_unreferenced_vertices_do_not_move_the_lattice(glasses, plain):
    strays = [[1e5, 0, 0], [-70, 1, -118]]
    weights = weights_of(np.vstack([glasses.vertices, strays]), glasses.faces, glasses.handles)
    assert_array_equal(weights[: len(plain)], plain)
    assert weights[-1, 0] > 0.9


def test_a_part_within_reach_is_bridged(glasses, plain):
    """A nose pad 4 mm off the front, with no key point of its own, follows the front beside it."""
    pad = rod([-12, 0, 8], [12, 0, 8])
    whole, of_pad = np.split(weights_of(*with_part(glasses, pad), glasses.handles), [len(plain)])
    assert of_pad[:, 3].min() > 0.5
    assert np.abs(whole - plain).max() < 0.1


@pytest.mark.parametrize("distance", [60.0, 1e4])
def test_floaters_move_in_one_piece_each_and_disturb_nothing(glasses, plain, distance):
    dust = [rod([x, distance, -118], [x + 10, distance, -118]) for x in (-70, 60)]
    found = solve_weights(*with_part(glasses, join(dust)), glasses.handles, SPACING)
    whole, left, right = np.split(found.weights, len(plain) + np.array([0, len(dust[0][0])]))
    assert_allclose(whole, plain, atol=1e-12)
    for own, handle in ((left, 0), (right, 6)):
        assert np.abs(own - own[0]).max() == 0
        assert own[0, handle] > 0.5
    assert found.plan[1].evidence == f"2 parts, {len(left) + len(right)} vertices"


def test_parts_closer_than_the_spacing_become_one():
    """Two temples 1 mm apart, one without a key point: it goes where the other goes."""
    both = join([rod([x, 0, 0], [x, 0, 60]) for x in (0, 5)])
    one, other = np.split(weights_of(*both, [[0, 0, 2], [0, 0, 58]]), 2)
    assert np.abs(one - other).max() < 0.25


def test_parts_out_of_reach_with_key_points_of_their_own(glasses):
    """A pair whose temples lie in the box beside it: each part follows its own key points alone."""
    handles = np.vstack([glasses.handles, [[0, 200, 5], [0, 200, 55]]])
    weights = weights_of(*with_part(glasses, rod([0, 200, 0], [0, 200, 60])), handles)
    whole, of_rod = np.split(weights, [len(glasses.vertices)])
    assert of_rod[:, :7].max() == whole[:, 7:].max() == 0


def test_a_mesh_far_larger_than_its_key_points_is_refused():
    sheet, faces = grid(9, 9)
    with pytest.raises(EyeglassesError, match="no lattice of 10000 nodes"):
        bounded_biharmonic_weights(1e4 * sheet, faces, [[1.0, 1.0, 0.0], [3.0, 1.0, 0.0]])
