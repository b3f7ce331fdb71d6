import numpy as np
import pytest
from helpers.face_mask import mask_surface
from helpers.meshes import grid
from numpy.testing import assert_allclose

from scan2albedo.fitting.forces import ForceGates, robust_weights, scan_forces, springs
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import scan_near_model
from scan2albedo.geometry.mesh import boundary_vertex_mask, join

GATES = ForceGates(10.0, 0.1, 0.5)


def plane_scan(size=21):
    vertices, faces = mask_surface(size)
    vertices = vertices * [1, 1, 0]
    return scan_near_model(vertices, faces, np.eye(4), vertices.min(0) - 500, vertices.max(0) + 500)


UP = np.array([[0.0, 0.0, 1.0]])


def packed(matrices):
    """The six different numbers of symmetric matrices (N, 3, 3)."""
    return matrices[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def test_pull_is_one_across_and_a_tenth_along_the_surface():
    forces = scan_forces(plane_scan(), np.array([[5.0, 5.0, 2.0]]), UP, GATES)
    force, stiffness = forces.springs(np.array([3.0]), np.array([True]))
    weight = 3.0 * forces.weight[0]
    assert force[0] == pytest.approx(weight * np.array([0, 0, -2.0]), abs=1e-9)
    assert stiffness[0] == pytest.approx(weight * np.array([0.1, 0.1, 1, 0, 0, 0]), abs=1e-9)
    assert 0 < forces.weight[0] <= 1


def test_springs_are_the_plain_matrices():
    rng = np.random.default_rng(0)
    offset, normal, (across, along) = rng.normal(size=(7, 3)), rng.normal(size=(7, 3)), rng.random((2, 7))
    force, stiffness = springs(offset, normal, across, along)
    outer = normal[:, :, None] * normal[:, None]
    matrix = across[:, None, None] * outer + along[:, None, None] * np.eye(3)
    assert_allclose(force, np.einsum("nij,nj->ni", matrix, offset))
    assert_allclose(stiffness, packed(matrix))


def test_spring_product_is_the_plain_product(mask_model):
    samples = SurfaceSamples.of(mask_model, mask_model.control_vertices, 1)
    rng = np.random.default_rng(1)
    count = samples.matrix.shape[0]
    root = rng.normal(size=(count, 3, 3))
    full = root + root.transpose(0, 2, 1)
    x = rng.normal(size=(samples.matrix.shape[1], 3))
    expected = samples.matrix.T @ np.einsum("nij,nj->ni", full, samples.matrix @ x)
    assert_allclose(samples.product(packed(full))(x), expected, atol=1e-9)


def test_a_sheet_hidden_behind_another_is_not_pulled_through_it():
    sheet = 60 * grid(13, 13)[0] - [30, 30, 0]
    samples = np.concatenate([sheet + 0.5 * UP, sheet - 4 * UP])
    forces = scan_forces(plane_scan(41), samples, np.tile(UP, (len(samples), 1)), GATES)
    front, behind = np.split(forces.mutual(samples, np.full(len(samples), 25.0)), 2)
    assert front.all()
    assert not behind.any()


@pytest.mark.parametrize(
    ("point", "normal"),
    [
        ([5.0, 5.0, 12.0], UP),  # beyond the gate
        ([5.0, 5.0, 2.0], -UP),  # looks the other way
        ([75.0, 5.0, 0.0], UP),  # beside the scan's border
    ],
)
def test_closed_gates_pull_at_nothing(point, normal):
    forces = scan_forces(plane_scan(), np.array([point]), normal, GATES)
    assert not forces.springs(np.ones(1), np.array([True]))[0].any()
    assert not forces.weight.any()


def test_robust_weights_fall_with_the_residual_and_forget_outliers():
    residual = np.concatenate([np.linspace(-1, 1, 101), [50.0]])
    weights = robust_weights(residual, np.ones(102, bool), GATES)
    assert weights[50] == pytest.approx(1)
    assert weights[100] > 0.6
    assert weights[101] < 1e-3


def test_seams_are_no_borders_and_floaters_pull_at_nothing():
    vertices, faces = mask_surface(41)
    count, right = len(vertices), vertices[faces, 0].mean(1) >= 0
    floater = np.eye(3) + [0, 0, 300], np.arange(3)[None]
    split, index = join([(vertices, faces[~right]), (vertices, faces[right]), floater])
    surface = scan_near_model(split, index, np.eye(4), split.min(0), split.max(0))
    assert len(surface.vertices) == count
    assert surface.boundary.sum() == 4 * 40


def test_a_scan_elsewhere_gives_none():
    vertices, faces = mask_surface(5)
    assert scan_near_model(vertices + 1e4, faces, np.eye(4), vertices.min(0), vertices.max(0)) is None


def test_at_the_rim_what_stands_before_the_model_hardly_pulls():
    """A sheet of hair 4 mm before the model, and skin 4 mm behind it, seen from rim and middle."""
    points = np.tile([5.0, 5.0, 0.01], (240, 1))
    points[:20, 2] = -4.0
    points[20:40, 2] = 4.0
    rim = np.zeros(240)
    rim[[*range(10), *range(20, 30)]] = 1.0
    gates = ForceGates(10.0, 0.1, 3.0)
    weight = scan_forces(plane_scan(), points, np.tile(UP, (240, 1)), gates, rim=rim).weight
    before_rim, before_middle, behind_rim, behind_middle = weight[:40].reshape(4, 10).mean(1)
    assert before_middle > 0.6
    assert before_rim < 0.01
    assert behind_rim == behind_middle == before_middle


def test_the_rim_of_a_model_fades_inward(mask_model):
    samples = SurfaceSamples.of(mask_model, mask_model.control_vertices, 1)
    points = samples.matrix @ mask_model.control_vertices
    border = boundary_vertex_mask(len(points), samples.faces)
    assert (samples.rim[border] == 1).all()
    assert samples.rim[np.argmax(points[:, 2])] == 0
    assert 0.3 < samples.rim.mean() < 0.7
