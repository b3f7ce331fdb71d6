import numpy as np
import pytest
from helpers.meshes import grid, sphere
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.core.lights import PointLight
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import linear_to_srgb
from scan2albedo.synthetic.renderer import (
    Material,
    RayScene,
    auto_exposure,
    incident_light,
    oren_nayar,
    phong,
    photograph,
    render,
)

LAMBERT = Material(sigma_rad=0.0)


def upward(count):
    """Return as many normals (count, 3)."""
    return np.tile([0.0, 0, 1], (count, 1))


def unit(*angles_deg):
    """Directions at (theta, phi) about +z."""
    theta, phi = np.deg2rad(np.array(angles_deg, float)).T
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)


@pytest.fixture(scope="module")
def sphere_normals():
    return normalized(np.random.default_rng(0).normal(size=(4000, 3)))


def test_lambert_sphere_is_one_plus_the_cosine(sphere_normals):
    light = PointLight(np.deg2rad(30), np.deg2rad(-20), intensity=2.5)
    albedo = np.full((len(sphere_normals), 3), [0.5, 0.3, 0.2])
    made = render(80 * sphere_normals, sphere_normals, albedo, [light], material=LAMBERT)
    expected = 1 + 2.5 * np.maximum(0, sphere_normals @ light.direction)
    assert_allclose(made.shading, expected, atol=1e-12)
    assert_allclose(made.radiance_linear, albedo * expected[:, None], atol=1e-12)
    assert_array_equal(made.visible[:, 0], sphere_normals @ light.direction > 0)


def test_lights_add_up(sphere_normals):
    lights = [PointLight(0.4, 0.1, 700.0, 2.0), PointLight(-0.8, 0.3, intensity=1.0)]
    albedo, material = np.full((len(sphere_normals), 3), 0.5), Material(0.4, 0.2, 12.0)
    together = render(80 * sphere_normals, sphere_normals, albedo, lights, material=material)
    apart = [render(80 * sphere_normals, sphere_normals, albedo, [x], material=material) for x in lights]
    assert_allclose(together.shading - 1, sum(a.shading - 1 for a in apart), atol=1e-12)
    assert_allclose(together.specular, sum(a.specular for a in apart), atol=1e-12)


def test_near_light_falls_off_with_the_square():
    light = PointLight(0.0, 0.0, 500.0, 3.0)
    points = np.array([[0.0, 0, 0], [0, 0, 250], [0, 0, -500]])
    toward, reach, irradiance = incident_light(points, light)
    assert_allclose(irradiance, [3.0, 12.0, 0.75])
    assert_allclose(reach, [500, 250, 1000])
    assert_allclose(toward, np.tile([0, 0, 1], (3, 1)))


def test_oren_nayar_against_its_formula_by_hand_however_the_surface_is_turned():
    a, b = 1 - 0.5 * 0.25 / (0.25 + 0.33), 0.45 * 0.25 / (0.25 + 0.09)
    # Viewer on the light's side, beside it, across, opposite it, straight above, and below the light.
    light = unit((60, 0), (60, 0), (60, 0), (60, 0), (60, 0), (30, 0))
    view = unit((30, 0), (30, 60), (30, 90), (30, 180), (0, 0), (60, 0))
    forward, steep = np.array([1, 0.5, 0, 0, 0, 1]), np.sin(np.deg2rad(60)) * np.tan(np.deg2rad(30))
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    value = oren_nayar(upward(6) @ turn, light @ turn, view @ turn, 0.5)
    assert_allclose(value, light[:, 2] * (a + b * forward * steep))


def test_grazing_and_hidden_views_stay_finite():
    light = unit((90, 0), (89.9999, 0), (60, 0), (0, 0))
    view = unit((90, 0), (89.9999, 0), (150, 0), (180, 0))
    value = oren_nayar(upward(4), light, view, 0.6)
    assert (value >= -1e-12).all()
    assert (value < 2).all()


def test_phong_peaks_at_the_mirror_direction():
    light, view = unit((40, 0), (40, 0), (40, 0)), unit((40, 180), (10, 180), (60, 0))
    assert_allclose(phong(upward(3), light, view, 10.0), [1, np.cos(np.deg2rad(30)) ** 10, 0], atol=1e-12)


def test_a_sphere_casts_its_shadow_on_a_plane():
    light = PointLight(np.deg2rad(30), 0.0)
    points = grid(241, 161)[0] * [120, 80, 0] - [60, 40, 0]
    occluder = RayScene(*sphere(5, 10.0, (0, 0, 40)))
    made = render(
        points, upward(len(points)), np.ones_like(points), [light], material=LAMBERT, occluder=occluder
    )
    from_axis = np.linalg.norm(np.cross(points - [0, 0, 40], light.direction), axis=1)
    clear = np.abs(from_axis - 10) > 0.1
    assert_array_equal(~made.visible[clear, 0], from_axis[clear] < 10)


def test_a_near_light_between_surface_and_obstacle_is_not_shadowed():
    scene = RayScene(*sphere(3, 10.0, (0, 0, 300)))
    for distance_mm, seen in ((200.0, True), (400.0, False)):
        light = PointLight(0, 0, distance_mm)
        made = render(np.zeros((1, 3)), upward(1), np.ones((1, 3)), [light], material=LAMBERT, occluder=scene)
        assert made.visible[0, 0] == seen


def test_occlusion_agrees_with_that_of_another_library():
    rng = np.random.default_rng(2)
    vertices, faces = rng.normal(size=(60, 3)) * 30 + 1000, rng.integers(0, 60, size=(40, 3))
    origins, aim = rng.normal(size=(2, 300, 3)) * [[[60]], [[20]]] + 1000
    directions = normalized(aim - origins)
    expected = RayCaster(vertices, faces).occluded(origins, directions)
    assert_array_equal(RayScene(vertices, faces).occluded(origins, directions), expected)
    assert 0.1 < expected.mean() < 0.95


def shoot(radiance, **options):
    settings = {"exposure": 1.0, "noise": 0.0, "bits": None, "rng": np.random.default_rng(0), **options}
    return photograph(radiance, **settings)


def test_eight_bits_leave_256_levels_and_half_a_step_of_error():
    x = np.linspace(0, 1, 20001)
    stored = shoot(x, bits=8)
    assert len(np.unique(stored)) == 256
    assert np.abs(linear_to_srgb(stored) - linear_to_srgb(x)).max() <= 0.5 / 255 + 1e-6


def test_clean_picture_is_exposed_and_clipped_only():
    assert shoot(np.array([0.2, 0.5, 3.0]), exposure=0.5).tolist() == pytest.approx([0.1, 0.25, 1.0])


def test_automatic_exposure_stays_below_white():
    radiance = np.random.default_rng(0).uniform(0, 7, (10, 3))
    assert (radiance * auto_exposure(radiance)).max() == pytest.approx(0.98)
    assert auto_exposure(np.zeros(3)) == 1.0


def test_noise_has_its_standard_deviation():
    noisy = shoot(np.full(100000, 0.5), noise=0.02)
    assert noisy.std() == pytest.approx(0.02, rel=0.02)
    assert noisy.mean() == pytest.approx(0.5, abs=0.001)
