"""Cast shadows against closed forms."""

import math

import numpy as np
import pytest
import trimesh
from helpers.meshes import grid

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import ShadowMap, VisibilityTable, cone_directions, view_frame

RADIUS = 20.0
HEIGHT = 60.0


TOWARD = np.array([0.4, 0.1, 1.0]) / np.linalg.norm([0.4, 0.1, 1.0])


def _sphere_over_plane(scale=1.0):
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    corners, square = grid(2, 2)
    vertices = np.concatenate([sphere.vertices + [0, 0, HEIGHT], 400 * corners - [200, 200, 0]])
    faces = np.concatenate([sphere.faces, square + len(sphere.vertices)])
    return RayCaster(scale * vertices, faces)


def _plane_points():
    points = 300 * grid(120, 120)[0] - [150, 150, 0]
    return points, np.broadcast_to([0, 0, 1.0], points.shape)


@pytest.mark.parametrize(
    ("distance_mm", "scale", "edge"),
    [(math.inf, 1.0, 0.3), (400.0, 1.0, 0.3), (math.inf, 1e-6, 1.2), (math.inf, 1e6, 0.3)],
)
def test_shadow_of_a_sphere_over_a_plane_in_any_unit_of_length(distance_mm, scale, edge):
    """At 1e6 an offset of 0.2 would let the plane shadow itself, at 1e-6 it would lie above the sphere."""
    points, normals = _plane_points()
    shadows = ShadowMap(_sphere_over_plane(scale), scale * points, normals)
    visible = shadows.visible(TOWARD, distance_mm)
    toward = normalized(TOWARD - points / distance_mm)
    center = np.array([0, 0, HEIGHT]) - points
    # Of the sphere's centre from the line through each point toward the light.
    distance = np.linalg.norm(np.cross(center, toward), axis=1)
    clear = np.abs(distance - RADIUS) > edge
    assert np.array_equal(visible[clear] == 0, distance[clear] < RADIUS)
    assert 100 < np.sum(visible == 0) < 2000


def test_surfaces_turned_away_are_dark_without_any_ray():
    shadows = ShadowMap(None, *_plane_points())
    assert not shadows.visible([0, 0, -1.0]).any()
    assert not shadows.visible([1.0, 0, 0]).any()
    assert shadows.visible([0, 0.1, 0.99]).all()
    assert (shadows.reached([0, 0, 1.0], 900.0, 5.0) == 1).all()


def test_a_lit_plane_does_not_shadow_itself():
    caster = RayCaster([[-200, -200, 0], [200, -200, 0], [0, 300, 0.0]], [[0, 1, 2]])
    grazing = np.array([math.cos(0.02), 0, math.sin(0.02)])
    assert ShadowMap(caster, *_plane_points()).visible(grazing).all()


def test_table_answers_with_the_nearest_direction():
    shadows = ShadowMap(_sphere_over_plane(), *_plane_points())
    directions = cone_directions(30, (0, 0, 1), 1.2)
    nearest = shadows.table(directions).nearest(normalized(directions[7] + 0.01))
    assert np.array_equal(nearest, shadows.visible(directions[7]))


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 1, 0), (1, -2, 0.5), (0, 0, -1)])
def test_frames_are_right_handed_and_cones_keep_their_angle(axis):
    frame = view_frame(axis)
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)
    assert np.all(cone_directions(100, axis, 0.7) @ normalized(np.array(axis)) >= math.cos(0.7))
    assert view_frame((0, 0, 3)) == pytest.approx(np.eye(3))


def test_a_lamp_of_some_size_has_a_penumbra_as_wide_as_it_is_seen():
    """Below the edge of a half plane: the part of the disc that lies beyond the edge."""
    corners, faces = grid(2, 2)
    caster = RayCaster(corners * [900, 1800, 0] + [0, -900, HEIGHT], faces)
    x = np.linspace(-30, 30, 61)
    points = np.stack([x, 0 * x, 0 * x], 1)
    shadows = ShadowMap(caster, points, np.broadcast_to([0, 0, 1.0], points.shape), 1e-3)
    radius_deg = 10.0
    lit = shadows.reached([0, 0, 1.0], math.inf, radius_deg)
    chord = np.clip(x / (HEIGHT * math.tan(math.radians(radius_deg))), -1, 1)
    expected = (np.arccos(chord) - chord * np.sqrt(1 - chord**2)) / math.pi
    assert lit.dtype == np.float32
    assert np.abs(lit - expected).max() < 0.1
    assert np.abs(lit - expected).mean() < 0.03
    assert np.array_equal(shadows.reached([0, 0, 1.0]), shadows.visible([0, 0, 1.0]))


def test_no_ray_is_shot_where_the_surface_is_known_to_be_open():
    points, normals = _plane_points()
    caster = _sphere_over_plane()
    shadows = ShadowMap(caster, points, normals)
    open_above = np.where(np.arange(len(points)) % 2, 0.7, 1.0)
    spared = ShadowMap(caster, points, normals, open_above=open_above)
    assert np.array_equal(spared.visible(TOWARD), np.where(open_above < 1, 1, shadows.visible(TOWARD)))
    for distance_mm in (math.inf, 900.0):
        hidden, sure = (s.reached(TOWARD, distance_mm, 4.0) for s in (shadows, spared))
        assert np.array_equal(sure, np.where(open_above < 1, 1, hidden))
        assert (hidden[open_above < 1] < 1).any()


def test_a_table_tells_how_high_above_the_surface_directions_are_hidden():
    points, normals = np.zeros((2, 3)), np.array([[0, 0, 1.0], [0, 0.6, 0.8]])
    toward = np.array([[0, 0, 1.0], [0.6, 0, 0.8], [0, 0, -1.0]])
    table = VisibilityTable(toward, np.array([[1, 0], [0, 1], [0, 0]], np.uint8))
    assert table.highest_hidden(normals) == pytest.approx([0.8, 0.8])
    nothing = VisibilityTable(toward, np.ones((3, len(points)), np.uint8))
    assert nothing.highest_hidden(normals).tolist() == [0, 0]
