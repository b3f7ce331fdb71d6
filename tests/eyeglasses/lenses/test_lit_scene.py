"""Surfaces under distant lights: closed forms, shadows where the geometry says, colours of meshes."""

from dataclasses import replace

import numpy as np
import pytest
from brdf_reference import oren_nayar, phong
from helpers.meshes import sphere
from helpers.plates import CORNERS, FACES, plate
from numpy.testing import assert_allclose

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.inserted_lenses import insert_lens
from scan2albedo.eyeglasses.lenses.optics import LensMaterial
from scan2albedo.eyeglasses.lenses.scene_colors import LitScene
from scan2albedo.eyeglasses.lenses.scenes import LensScene, Surface, radiance_at
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rasterization import bilinear
from scan2albedo.lighting.environment import DistantLights, distant_directions
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.synthetic import eyeglasses


def look_down(scene, xy, z=100.0):
    """Rays along -z at points (N, 2)."""
    down = np.broadcast_to([0.0, 0, -1], (len(xy), 3))
    return scene.rays(np.column_stack([xy, np.full(len(xy), z)]), down)


def seen_from_above(scene, xy, lights, environment=None, z=100.0):
    return LitScene(scene, (), lights, environment).seen(look_down(scene, xy, z))


def test_the_back_of_a_one_sided_surface_is_not_seen_but_casts_shadows():
    scene = LensScene(plate(10, -50), [replace(plate(60, 0), one_sided=True)])
    xy = np.random.default_rng(0).uniform(-50, 50, (200, 2))
    small = (np.abs(xy) < 10).all(1)
    from_front = look_down(scene, xy)
    up = -from_front.directions
    from_behind = scene.rays(from_front.origins + 200 * from_front.directions, up).hits
    assert (scene.surface_of_face[from_front.hits.face] == 1).all()
    assert (from_behind.face[~small] < 0).all()
    assert np.isinf(from_behind.distance[~small]).all()
    assert (scene.surface_of_face[from_behind.face[small]] == 0).all()
    assert not ShadowMap(scene.caster, from_front.ends - [0, 0, 20], up).visible([0, 0, 1]).any()


def test_a_scene_does_what_the_reference_says():
    """Rough and glossy surfaces, seen from many sides, with a lens in the way of some of the light."""
    glasses, rng = eyeglasses(1), np.random.default_rng(0)
    albedo = np.array([0.2, 0.5, 0.8])
    finish = {"roughness_rad": 0.4, "specular": 0.3, "shininess": 20.0, "albedo_linear": albedo}
    scene = LensScene(Surface(glasses.vertices, glasses.faces), [plate(80, -30, **finish)])
    dyed = LensMaterial(tint_linear=(1, 0.5, 0.2), alpha=0.9, tinting="filter")
    lenses = [insert_lens(glasses.vertices, glasses.faces, glasses.keypoints, side, dyed) for side in (0, 1)]
    toward, light = distant_directions(30), rng.random((30, 3))
    targets = rng.uniform([-70, -70, -30], [70, 70, -30], (400, 3))
    origin = np.array([150.0, 100, 300])
    rays = scene.rays(origin, normalized(targets - origin))
    on = scene.surface_of_face[rays.hits.face] == 1
    colors = LitScene(scene, lenses, DistantLights(toward, light), None).seen(rays)
    ways, above = set(), rays.ends + [0, 0, 0.2]
    bare = shaded = np.zeros(3)
    for way, sent in zip(toward[toward[:, 2] > 0], light[toward[:, 2] > 0], strict=True):
        angles = way[2], -rays.directions[:, 2], -rays.directions @ way
        open_ = ~scene.caster.occluded(above, way)
        matte = albedo / np.pi * oren_nayar(*angles, 0.4)[:, None]
        sent = sent * open_[:, None] * (matte + 0.3 * phong(*angles, 20.0)[:, None])
        crossed = sum(lens.caster.occluded(rays.ends, way).astype(int) for lens in lenses)
        bare = bare + sent
        shaded = shaded + sent * dyed.transmission ** crossed[:, None]
        ways |= set((open_ + crossed * open_).flat)
    assert on.sum() > 200
    assert ways >= {0, 1, 2}
    assert_allclose(colors.bare[on], bare[on], rtol=1e-9, atol=1e-12)
    assert_allclose(colors.shaded[on], shaded[on], rtol=1e-9, atol=1e-12)
    assert not colors.unknown.any()


def test_a_plate_has_lamberts_radiance_on_both_sides_and_for_any_winding():
    xy = np.array([[3.0, 4], [-7, 2]])
    for faces in (FACES, [[0, 2, 1], [0, 2, 3]]):
        scene = LensScene(replace(plate(10, 0, albedo_linear=[0.5, 0.5, 1]), faces=faces), ())
        seen = seen_from_above(scene, xy, DistantLights([[0.6, 0, 0.8]], [[1.0, 2, 3]])).bare
        assert_allclose(seen, np.tile([0.4, 0.8, 2.4], (2, 1)) / np.pi, rtol=1e-12)
    assert not seen_from_above(scene, xy, DistantLights([[-0.6, 0, -0.8]], [1.0])).bare.any()


def test_rays_past_everything_see_the_environment():
    past = LensScene(plate(10, 0), ()), [[50.0, 0]], DistantLights([[0, 0, 1]], [1.0])
    seen = seen_from_above(*past, np.full((4, 8, 3), 5.0))
    assert seen.bare.tolist() == seen.shaded.tolist() == [[5] * 3]
    assert not seen_from_above(*past).shaded.any()


def test_the_environment_lies_where_its_axes_say():
    polar, azimuth = np.deg2rad(np.mgrid[:180, -180:180] + 0.5)
    around = np.sin(polar)
    toward = np.stack([around * np.sin(azimuth), np.cos(polar), around * np.cos(azimuth)], -1)
    directions = np.concatenate([distant_directions(300), np.eye(3), -np.eye(3)])
    assert_allclose(radiance_at(toward, 7 * directions), directions, atol=0.01)
    assert not radiance_at(None, directions).any()


def test_colours_come_from_vertices_or_textures():
    image = np.random.default_rng(2).random((8, 16, 3))
    by_vertex = (CORNERS + 1) / 2
    xy = np.random.default_rng(3).uniform(-10, 10, (50, 2))
    texel = (xy * [1, -1] + 10) / 20 * [16, 8] - 0.5
    for uv in (by_vertex, by_vertex[FACES]):
        scene = LensScene(plate(1, -50), [plate(10, 0, uv=uv, texture_linear=image)])
        rays = look_down(scene, xy)
        assert (scene.surface_of_face[rays.hits.face] == 1).all()
        assert_allclose(scene.albedo(rays), bilinear(image, texel), atol=1e-12)
    scene = LensScene(plate(10, 0, albedo_linear=np.eye(4)[:, :3]), ())
    rays = look_down(scene, np.array([[-10.0, -10], [10, -10]]) * 0.999999)
    assert_allclose(scene.albedo(rays), np.eye(3)[:2], atol=1e-5)


def test_normals_are_smooth_where_the_winding_is_one():
    vertices, faces = sphere(3, 80.0)
    for winding in (faces, faces[:, ::-1]):
        scene = LensScene(Surface(vertices, winding), ())
        rays = look_down(scene, np.array([[5.0, 1], [-20, 3], [12, -4]]))
        assert ((scene.normals(rays) * normalized(rays.ends)).sum(1) > 0.9999).all()


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"faces": np.zeros((0, 3), int)}, EyeglassesError, "no faces"),
        ({"albedo_linear": [np.nan, 0, 0]}, EyeglassesError, "albedo_linear"),
        ({"albedo_linear": np.zeros((4, 3))}, ValueError, "albedo_linear must"),
        ({"texture_linear": np.ones((2, 2, 3))}, ValueError, "needs uv"),
        ({"uv": np.zeros((2, 2)), "texture_linear": np.ones((2, 2, 3))}, ValueError, "uv must"),
    ],
)
def test_what_is_no_surface_is_refused(changes, kind, words):
    with pytest.raises(kind, match=words):
        Surface(**{"vertices": np.eye(3), "faces": [[0, 1, 2]], **changes})
