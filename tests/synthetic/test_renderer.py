import ast
from pathlib import Path

import numpy as np
import pytest
import trimesh

import scan2albedo.synthetic
from scan2albedo.core.lights import PointLight
from scan2albedo.geometry.mesh import normalized
from scan2albedo.synthetic.renderer import Material, RayScene, incident_light, oren_nayar, phong, render

LAMBERT = Material(sigma_rad=0.0)


def unit(*angles_deg):
    """Directions at (theta, phi) about +z."""
    theta, phi = np.deg2rad(np.array(angles_deg, float)).T
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)


@pytest.fixture(scope="module")
def sphere_normals():
    return normalized(np.random.default_rng(0).normal(size=(4000, 3)))


def test_estimator_code_is_not_shared():
    forbidden = ("lighting.shadow_map", "lighting.shading", "geometry.rays", "albedo")
    folder = Path(scan2albedo.synthetic.__file__).parent
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not any(f"scan2albedo.{f}" in n for f in forbidden for n in names), path


def test_lambert_sphere_is_one_plus_the_cosine(sphere_normals):
    light = PointLight(np.deg2rad(30), np.deg2rad(-20), intensity=2.5)
    albedo = np.full((len(sphere_normals), 3), [0.5, 0.3, 0.2])
    made = render(80 * sphere_normals, sphere_normals, albedo, [light], material=LAMBERT)
    expected = 1 + 2.5 * np.maximum(0, sphere_normals @ light.direction)
    assert np.allclose(made.shading, expected, atol=1e-12)
    assert np.allclose(made.radiance_linear, albedo * expected[:, None], atol=1e-12)
    assert np.array_equal(made.visible[:, 0], sphere_normals @ light.direction > 0)


def test_lights_add_up(sphere_normals):
    lights = [PointLight(0.4, 0.1, 700.0, 2.0), PointLight(-0.8, 0.3, intensity=1.0)]
    albedo, material = np.full((len(sphere_normals), 3), 0.5), Material(0.4, 0.2, 12.0)
    together = render(80 * sphere_normals, sphere_normals, albedo, lights, material=material)
    apart = [render(80 * sphere_normals, sphere_normals, albedo, [x], material=material) for x in lights]
    assert np.allclose(together.shading - 1, sum(a.shading - 1 for a in apart))
    assert np.allclose(together.specular, sum(a.specular for a in apart))


def test_near_light_falls_off_with_the_square():
    light = PointLight(0.0, 0.0, 500.0, 3.0)
    points = np.array([[0.0, 0, 0], [0, 0, 250], [0, 0, -500]])
    toward, reach, irradiance = incident_light(points, light)
    assert np.allclose(irradiance, [3.0, 12.0, 0.75])
    assert np.allclose(reach, [500, 250, 1000])
    assert np.allclose(toward, [0, 0, 1])


def test_oren_nayar_without_roughness_is_lambert():
    light, view = unit((0, 0), (35, 10), (80, 200)), unit((20, 0), (70, 180), (5, 30))
    value = oren_nayar(np.tile([0.0, 0, 1], (3, 1)), light, view, 0.0)
    assert np.allclose(value, light[:, 2], atol=1e-12)


def test_oren_nayar_against_its_formula_by_hand():
    sigma = 0.5
    a, b = 1 - 0.5 * 0.25 / (0.25 + 0.33), 0.45 * 0.25 / (0.25 + 0.09)
    n = np.tile([0.0, 0, 1], (4, 1))
    # Viewer on the light's side, opposite it, across, and straight above.
    light = unit((60, 0), (60, 0), (60, 0), (60, 0))
    view = unit((30, 0), (30, 180), (30, 90), (0, 0))
    back = 0.5 * (a + b * np.sin(np.deg2rad(60)) * np.tan(np.deg2rad(30)))
    assert np.allclose(oren_nayar(n, light, view, sigma), [back, 0.5 * a, 0.5 * a, 0.5 * a])


def test_oren_nayar_is_reciprocal_and_turns_with_the_surface(sphere_normals):
    rng = np.random.default_rng(1)
    n = sphere_normals
    light, view = map(normalized, rng.normal(size=(2, len(n), 3)))
    above = (np.einsum("ij,ij->i", n, light) > 0.05) & (np.einsum("ij,ij->i", n, view) > 0.05)
    n, light, view = n[above], light[above], view[above]
    forward = oren_nayar(n, light, view, 0.4) / np.einsum("ij,ij->i", n, light)
    backward = oren_nayar(n, view, light, 0.4) / np.einsum("ij,ij->i", n, view)
    assert np.allclose(forward, backward)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert np.allclose(oren_nayar(n @ turn, light @ turn, view @ turn, 0.4), oren_nayar(n, light, view, 0.4))


def test_grazing_and_hidden_views_stay_finite():
    n = np.tile([0.0, 0, 1], (4, 1))
    light = unit((90, 0), (89.9999, 0), (60, 0), (0, 0))
    view = unit((90, 0), (89.9999, 0), (150, 0), (180, 0))
    value = oren_nayar(n, light, view, 0.6)
    assert (value >= -1e-12).all()
    assert (value < 2).all()


def test_phong_peaks_at_the_mirror_direction():
    n = np.tile([0.0, 0, 1], (3, 1))
    light, view = unit((40, 0), (40, 0), (40, 0)), unit((40, 180), (10, 180), (60, 0))
    assert np.allclose(phong(n, light, view, 10.0), [1, np.cos(np.deg2rad(30)) ** 10, 0], atol=1e-12)


def test_a_sphere_casts_its_shadow_on_a_plane():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=10.0)
    light = PointLight(np.deg2rad(30), 0.0)
    ball.apply_translation([0, 0, 40])
    plane = np.stack(np.meshgrid(np.linspace(-60, 60, 241), np.linspace(-40, 40, 161)), -1).reshape(-1, 2)
    points, up = np.column_stack([plane, np.zeros(len(plane))]), np.tile([0.0, 0, 1], (len(plane), 1))
    made = render(
        points,
        up,
        np.ones((len(plane), 3)),
        [light],
        material=LAMBERT,
        occluder=RayScene(ball.vertices, ball.faces),
    )
    from_axis = np.linalg.norm(np.cross(points - [0, 0, 40], light.direction), axis=1)
    clear = np.abs(from_axis - 10) > 0.1
    assert np.array_equal(~made.visible[clear, 0], from_axis[clear] < 10)
    shadow = points[~made.visible[:, 0]]
    assert shadow[:, 0].mean() == pytest.approx(-40 * np.tan(np.deg2rad(30)), abs=0.2)
    assert len(shadow) * 0.25 == pytest.approx(np.pi * 100 / np.cos(np.deg2rad(30)), rel=0.02)


def test_a_near_light_between_surface_and_obstacle_is_not_shadowed():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    ball.apply_translation([0, 0, 300])
    scene = RayScene(ball.vertices, ball.faces)
    ground = (np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.ones((1, 3)))
    for distance_mm, seen in ((200.0, True), (400.0, False)):
        made = render(*ground, [PointLight(0, 0, distance_mm)], material=LAMBERT, occluder=scene)
        assert made.visible[0, 0] == seen


def test_occlusion_agrees_with_every_triangle_tested_by_hand():
    rng = np.random.default_rng(2)
    vertices, faces = rng.normal(size=(60, 3)) * 30 + 1000, rng.integers(0, 60, size=(40, 3))
    faces = faces[[len(set(f)) == 3 for f in faces.tolist()]]
    origins, aim = rng.normal(size=(300, 3)) * 60 + 1000, rng.normal(size=(300, 3)) * 20 + 1000
    directions = normalized(aim - origins)
    expected = np.array([_hits_any(o, d, vertices[faces]) for o, d in zip(origins, directions, strict=True)])
    assert np.array_equal(RayScene(vertices, faces).occluded(origins, directions), expected)
    assert 0.1 < expected.mean() < 0.95


def _hits_any(origin, direction, triangles):
    for a, b, c in triangles:
        matrix = np.stack([direction, a - b, a - c], 1)
        t, u, v = np.linalg.solve(matrix, a - origin)
        if t > 0 and u >= 0 and v >= 0 and u + v <= 1:
            return True
    return False
