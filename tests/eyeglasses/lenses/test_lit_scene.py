"""Surfaces under distant lights: closed forms, shadows where the geometry says, colours of meshes."""

from dataclasses import dataclass

import numpy as np
import pytest
from brdf_reference import oren_nayar, phong

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.lens_scene import LensScene, Surface
from scan2albedo.eyeglasses.lenses.light_kernels import AWAY, shade
from scan2albedo.eyeglasses.lenses.lit_scene import LitScene
from scan2albedo.eyeglasses.lenses.traced_rays import Illumination, SceneRays
from scan2albedo.geometry.rasterization import bilinear
from scan2albedo.lighting.environment import DistantLights


def square(half, z, **finish):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    return Surface(np.column_stack([corners, np.full(4, z)]), [[0, 1, 2], [0, 2, 3]], **finish)


def look_down(scene, xy, z=100.0):
    """Rays along -z at points (N, 2)."""
    origins = np.column_stack([xy, np.full(len(xy), z)])
    directions = np.tile([0.0, 0, -1], (len(xy), 1))
    return SceneRays(origins, directions, scene.caster.first_hit(origins, directions))


@dataclass(frozen=True)
class Lit:
    """A scene in a light: colours of rays at once."""

    scene: LitScene
    light: Illumination

    def bare(self, rays):
        return self.scene.straight(np.zeros((len(rays.origins), 2)), rays).colors(self.light).bare

    def seen(self, rays):
        return self.scene.seen(rays).colors(self.light).shaded

    def mirrored(self, rays):
        return self.scene.mirrored(rays).colors(self.light).shaded


def lit(scene, lights, *, environment=None, background=False):
    toward = np.asarray(lights.directions)
    drawn = LitScene(scene, (), toward, background=background, offset_mm=0.1, every_pixel=True)
    return Lit(drawn, Illumination(np.asarray(lights.irradiance_linear), environment))


def test_the_kernel_does_what_the_reference_says():
    rng = np.random.default_rng(0)
    normal, viewer = rng.normal(size=(2, 500, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    viewer /= np.linalg.norm(viewer, axis=1)[:, None]
    toward = np.array([[0.48, 0.6, 0.64], [0, -1, 0]])
    light = np.array([[1.0, 2, 3], [0.5, 0.1, 0]])
    albedo, surface = rng.random((500, 3)), rng.integers(0, 3, 500)
    finish = np.array([[0.0, 0.0, 5.0], [0.4, 0.3, 20.0], [0.0, 1.0, 1.0]])
    passed = np.array([[1.0, 1, 1], [0.5, 0.2, 0]])
    paths = rng.integers(0, 3, (500, 2)).astype(np.uint8)
    expected_bare, expected = np.zeros((2, 500, 3))
    for k in range(2):
        n_l, n_v, l_v = normal @ toward[k], (normal * viewer).sum(1), viewer @ toward[k]
        paths[n_l <= 0, k] = AWAY
        for number, (sigma, specular, exponent) in enumerate(finish):
            own = (surface == number) & (paths[:, k] > 0) & (n_l > 0)
            matte = albedo[own] / np.pi * oren_nayar(n_l, n_v, l_v, sigma)[own, None]
            glossy = specular * phong(n_l, n_v, l_v, exponent)[own, None]
            expected_bare[own] += light[k] * (matte + glossy)
            expected[own] += light[k] * passed[paths[own, k] - 1] * (matte + glossy)
    bare, shaded = np.ones((2, 500, 3))
    shade(normal, viewer, albedo, surface, finish, paths, passed, toward, light, bare, shaded)
    np.testing.assert_allclose(bare, expected_bare, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(shaded, expected, rtol=1e-12, atol=1e-15)


def test_a_plate_has_lamberts_radiance_on_both_sides_and_for_any_winding():
    toward = np.array([[0.6, 0, 0.8]])
    lights = DistantLights(toward, [[1.0, 2, 3]])
    xy = np.array([[3.0, 4], [-7, 2]])
    for faces in ([[0, 1, 2], [0, 2, 3]], [[0, 2, 1], [0, 2, 3]]):
        plate = Surface(square(10, 0).vertices, faces, albedo_linear=[0.5, 0.5, 1])
        scene = LensScene(plate, ())
        seen = lit(scene, lights).seen(look_down(scene, xy))
        np.testing.assert_allclose(seen, np.tile([0.4 / np.pi, 0.8 / np.pi, 2.4 / np.pi], (2, 1)), rtol=1e-12)
    behind = lit(scene, DistantLights(-toward, [1.0])).seen(look_down(scene, xy))
    assert not behind.any()


def test_shadows_fall_where_the_geometry_says():
    scene = LensScene(square(10, 30), [square(100, 0)])
    toward = np.array([0.36, -0.48, 0.8])
    colors = lit(scene, DistantLights([toward], [[np.pi] * 3]))
    xy = np.random.default_rng(1).uniform(-60, 60, (4000, 2))
    # Where the way to the light crosses the small square's height.
    at = xy + 30 * toward[:2] / toward[2]
    from_edge = 10 - np.abs(at).max(1)
    below = look_down(scene, xy, z=20.0)
    dark = colors.bare(below)[:, 0] == 0
    clear = np.abs(from_edge) > 0.2
    assert (dark == (from_edge > 0))[clear].all()
    assert dark.sum() > 50
    np.testing.assert_allclose(colors.bare(below)[~dark], 0.5 * 0.8, rtol=1e-12)


def test_rays_past_everything_see_the_background_and_mirrors_the_environment():
    scene = LensScene(square(10, 0), ())
    room = np.full((4, 8, 3), 5.0)
    lights = DistantLights([[0, 0, 1]], [1.0])
    past = look_down(scene, np.array([[50.0, 0]]))
    seen = lit(scene, lights, environment=room, background=True)
    assert seen.bare(past).tolist() == seen.seen(past).tolist() == seen.mirrored(past).tolist() == [[5] * 3]
    black = lit(scene, lights, environment=room)
    assert not black.bare(past).any()
    assert not black.seen(past).any()
    assert black.mirrored(past).tolist() == [[5, 5, 5]]
    assert not lit(scene, lights, background=True).mirrored(past).any()


def test_colours_come_from_vertices_or_textures():
    image = np.random.default_rng(2).random((8, 16, 3))
    corner_uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    by_vertex = square(10, 0, uv=corner_uv, texture_linear=image)
    by_corner = square(10, 0, uv=corner_uv[by_vertex.faces], texture_linear=image)
    painted = square(10, 0, albedo_linear=np.eye(4)[:, :3])
    xy = np.random.default_rng(3).uniform(-10, 10, (50, 2))
    texel = np.stack([(xy[:, 0] + 10) / 20 * 16 - 0.5, (10 - xy[:, 1]) / 20 * 8 - 0.5], 1)
    for surface in (by_vertex, by_corner):
        scene = LensScene(square(1, -50), [surface])
        rays = look_down(scene, xy)
        points = scene.points(rays.origins, rays.directions, rays.hits)
        assert (points.surface == 1).all()
        np.testing.assert_allclose(scene.albedo(points), bilinear(image, texel), atol=1e-12)
    scene = LensScene(painted, ())
    rays = look_down(scene, np.array([[-10.0, -10], [10, -10]]) * 0.999999)
    albedo = scene.albedo(scene.points(rays.origins, rays.directions, rays.hits))
    np.testing.assert_allclose(albedo, np.eye(3)[:2], atol=1e-5)


def test_normals_are_smooth_where_the_winding_is_one():
    angle = np.linspace(-0.5, 0.5, 9)
    arc = np.concatenate(
        [np.stack([80 * np.sin(angle), np.full(9, y), 80 * np.cos(angle)], 1) for y in (-9, 9)]
    )
    a = np.arange(8)
    faces = np.concatenate([np.stack([a, a + 1, a + 10], 1), np.stack([a, a + 10, a + 9], 1)])
    for winding in (faces, faces[:, ::-1]):
        scene = LensScene(Surface(arc, winding), ())
        rays = look_down(scene, np.array([[5.0, 1], [-20, 3], [12, -4]]))
        points = scene.points(rays.origins, rays.directions, rays.hits)
        radial = points.position * [1, 0, 1]
        radial /= np.linalg.norm(radial, axis=1)[:, None]
        assert ((points.normal * radial).sum(1) > 0.9999).all()


def test_what_is_no_surface_is_refused():
    triangle = np.eye(3)
    with pytest.raises(EyeglassesError, match="no faces"):
        Surface(triangle, np.zeros((0, 3), int))
    with pytest.raises(EyeglassesError, match="not finite"):
        Surface(np.full((3, 3), np.nan), [[0, 1, 2]])
    with pytest.raises(EyeglassesError, match="albedo_linear"):
        Surface(triangle, [[0, 1, 2]], albedo_linear=[np.nan, 0, 0])
    with pytest.raises(ValueError, match="0 to 2"):
        Surface(triangle, [[0, 1, 3]])
    with pytest.raises(ValueError, match="integers"):
        Surface(triangle, [[0.0, 1, 2]])
    with pytest.raises(ValueError, match="vertices must"):
        Surface(np.zeros((3, 2)), [[0, 1, 2]])
    with pytest.raises(ValueError, match="albedo_linear must"):
        Surface(triangle, [[0, 1, 2]], albedo_linear=np.zeros((4, 3)))
    with pytest.raises(ValueError, match="needs uv"):
        Surface(triangle, [[0, 1, 2]], texture_linear=np.ones((2, 2, 3)))
    with pytest.raises(ValueError, match="uv must"):
        Surface(triangle, [[0, 1, 2]], uv=np.zeros((2, 2)), texture_linear=np.ones((2, 2, 3)))
