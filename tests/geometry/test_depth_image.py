"""Depth images against rays, closed forms and posed copies."""

import numpy as np
import pytest
import trimesh

from scan2albedo.geometry.depth_image import DepthFrame, depth_image
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import compose, random_rotation, transform_points


def bumpy(seed=0):
    mesh = trimesh.creation.icosphere(4, 1.0)
    vertices = np.asarray(mesh.vertices)
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(6, 3))
    bumps = 1 + 0.2 * np.exp(4 * (vertices @ (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T - 1)).sum(
        1
    )
    return vertices * bumps[:, None] * 70, np.asarray(mesh.faces)


@pytest.mark.parametrize("size", [1, 31, 64])
def test_depth_equals_the_first_hit_of_a_ray_from_the_viewer(size):
    vertices, faces = bumpy()
    frame = DepthFrame((5.0, -3.0), 190.0, size)
    pose = compose(random_rotation(np.random.default_rng(1)), [3.0, 4.0, -20.0])
    image = depth_image(vertices, faces, frame, pose)
    xy = frame.coordinates().reshape(-1, 2)
    origins = np.column_stack([xy, np.full(len(xy), 500.0)])
    hits = RayCaster(transform_points(pose, vertices), faces).first_hit(origins, [0, 0, -1.0])
    expected = np.where(hits.face >= 0, 500 - hits.distance, -np.inf).reshape(size, size)
    both = np.isfinite(image) & np.isfinite(expected)
    # A ray through a silhouette edge may go either way.
    assert (np.isfinite(image) != np.isfinite(expected)).mean() < 0.002
    np.testing.assert_allclose(image[both], expected[both], atol=2e-3)


def test_a_tilted_plane_is_exact():
    vertices = np.array([[-9.0, -9, 0], [9, -9, 18], [9, 9, 18], [-9, 9, 0]])
    image = depth_image(vertices, [[0, 1, 2], [0, 2, 3]], DepthFrame((0.0, 0.0), 10.0, 20))
    x = DepthFrame((0.0, 0.0), 10.0, 20).coordinates()[..., 0]
    np.testing.assert_allclose(image, x + 9, atol=1e-12)


def test_empty_pixels_are_minus_infinity_and_the_limit_looks_through():
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 2, 0], [-9, -9, 5], [9, -9, 5], [0, 20, 5]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    frame = DepthFrame((0.0, 0.0), 60.0, 61)
    assert depth_image(vertices, faces, frame)[30, 30] == 5
    assert depth_image(vertices, faces, frame, z_limit=4.0)[30, 30] == 0
    assert depth_image(vertices, faces, frame)[0, 0] == -np.inf


def test_rows_go_down_and_columns_right():
    frame = DepthFrame((10.0, 20.0), 8.0, 4)
    assert frame.pixel == 2
    assert frame.coordinates()[0, 0].tolist() == [7, 23]
    assert frame.coordinates()[3, 1].tolist() == [9, 17]


@pytest.mark.parametrize("jitter", [0.0, 1e-14, 0.3])
def test_neighbouring_faces_leave_no_pixel_between_them(jitter):
    # Without jitter every pixel centre lies on edges or corners of the grid; 1e-14 makes rows near level.
    side = np.arange(-4.0, 5.0)
    x, y = np.meshgrid(side, side)
    rng = np.random.default_rng(0)
    xy = np.stack([x, y], -1) + jitter * rng.uniform(-1, 1, (9, 9, 2))
    vertices = np.column_stack([xy.reshape(-1, 2), xy.reshape(-1, 2) @ [0.5, -0.25]])
    index = np.arange(81).reshape(9, 9)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    frame = DepthFrame((0.0, 0.0), 7.0, 7)
    image = depth_image(vertices, faces, frame)
    np.testing.assert_allclose(image, frame.coordinates() @ [0.5, -0.25], atol=1e-9)
    np.testing.assert_allclose(depth_image(vertices, faces[:, ::-1], frame), image, atol=1e-9)
