"""Relit faces: against an independent renderer, linear in the light, environments, pictures."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.meshes import grid
from helpers.processed_faces import person_scene
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import ProcessedFace, default_camera, relight
from scan2albedo.applications.relighting import RelightOptions
from scan2albedo.core import EnvironmentLight
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.pinhole import project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.shading import Reflectance, shade_points
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.synthetic import hemisphere, light_at


def shown(face, *lights, **options):
    """Return the linear texture (H, W, 3) of a face in some light, without any around."""
    return relight(face, lights, ambient=0, **options).texture_linear


def test_colours_of_lamps_and_of_soft_light_add_up(person):
    face = person(0)
    soft = EnvironmentLight(np.outer([3, 1, *7 * [0]], [0.3, 0.33, 0.4]), fill=0.3)
    lamp = replace(light_at(30, 20), color_linear=(1.5, 1.0, 0.5))
    assert relight(face, ambient=0).diffuse.max() == 0
    white, warm = (relight(face, [light], ambient=0) for light in (light_at(30, 20), lamp))
    assert_allclose(warm.diffuse, white.diffuse * lamp.color_linear, rtol=1e-6)
    assert_allclose(warm.specular, white.specular * lamp.color_linear, rtol=1e-6, atol=1e-30)
    around, both = (relight(face, lamps, environment=soft) for lamps in ((), [lamp]))
    assert_allclose(both.diffuse, around.diffuse + warm.diffuse, rtol=1e-5)
    even = EnvironmentLight(np.eye(9, 1) * np.ones(3))
    hidden = 1 - relight(face, environment=even).diffuse[face.mask]
    assert 0.05 < np.quantile(hidden, 0.9) < 0.8
    assert both.picture(shape=(32, 32)).linear.max() > 0


def test_a_large_lamp_softens_its_shadows_and_keeps_its_light(person):
    face, point = person(0), light_at(60, 20)
    large, without = replace(point, radius_deg=15), replace(face, casts_shadows=False)

    def diffuse(face, lamp):
        return relight(face, [lamp], ambient=0).diffuse[face.mask]

    hard, soft, full = diffuse(face, point), diffuse(face, large), diffuse(without, large)
    assert_array_equal(full, diffuse(without, point))
    assert soft.mean() == pytest.approx(hard.mean(), rel=0.05)
    between = (soft > 0.02 * full) & (soft < 0.98 * full)
    assert not ((hard > 0.02 * full) & (hard < 0.98 * full)).any()
    assert between.mean() > 0.03
    # Shadows only take light away.
    assert (hard <= full + 1e-6).all()
    assert (hard < 0.9 * full).mean() > 0.02


def test_its_own_lights_give_the_picture_back(person):
    made, face = person_scene(0), person(0)
    picture = (made.image.texture_linear / made.gain)[face.mask]
    error = relight(face, face.lights).texture_linear[face.mask] - picture
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(picture)


@pytest.mark.parametrize(("brdf", "roughness"), [("oren-nayar", 0.4), ("lambert", 0.0), ("minnaert", 1.3)])
def test_every_reflectance_agrees_with_the_compiled_kernel(person, brdf, roughness):
    reflectance = Reflectance(brdf, roughness, 0.1, 12.0)
    face = replace(person(0), reflectance=reflectance, casts_shadows=False)
    lights = [light_at(20, 10), light_at(-50, 30, distance_mm=400)]
    image, mask = face.image, face.mask
    surface, gloss = (image.position[mask], image.normal[mask]), image.specular_scale[mask]
    kernel = shade_points(*surface, lights, reflectance, specular_scale=gloss)
    relit = relight(face, lights)
    assert_allclose(relit.diffuse[mask][:, 0], kernel.light, rtol=1e-5)
    assert_allclose(relit.specular[mask][:, 0], kernel.specular, rtol=1e-5, atol=1e-7)


def test_linear_in_the_light(person):
    face = person(0)
    a, b = light_at(30, 20), [light_at(-60, 0, distance_mm=400), light_at(0, 50, intensity=1)]
    alone = shown(face, a)
    around, both = (relight(face, lights, ambient=0.7).texture_linear for lights in ((), [a, *b]))
    assert_allclose(both, alone + shown(face, *b) + around, rtol=1e-5, atol=1e-7)
    assert_allclose(shown(face, replace(a, intensity=2 * a.intensity)), 2 * alone, rtol=1e-6, atol=1e-8)
    assert np.ptp(alone[face.mask]) > 0.1


def test_environment_light_comes_from_where_it_is_bright():
    ball = hemisphere(size=48, texture="plain")
    face = ProcessedFace.of("ball", ball.image, ball.albedo_linear)
    even = DistantLights.from_environment(np.ones((16, 32, 3)), 400, "important")
    # Every texel of a convex ball sees its whole hemisphere of sky.
    assert_allclose(relight(face, environment_linear=even).diffuse[face.mask], 1.0, atol=0.03)
    sky = np.zeros((16, 32, 3))
    sky[7:9, 24:] = [1.0, 0.5, 0.0]  # azimuth above 90 degrees: +x, a little behind
    diffuse = relight(face, environment_linear=sky).diffuse
    right = ball.image.normal[..., 0] > 0.5
    left = ball.image.normal[..., 0] < -0.5
    assert diffuse[right].mean() > 5 * diffuse[left & face.mask].mean()
    assert_allclose(diffuse[right][:, 1], 0.5 * diffuse[right][:, 0], rtol=1e-5)
    assert not diffuse[..., 2].any()


def test_a_picture_shows_the_relit_texture_where_the_camera_looks(person):
    face = person(0)
    relit = relight(face, [light_at(20, 20)])
    shape = 128, 128
    camera = default_camera(face, shape)
    picture = relit.picture(camera, shape=shape, samples=1)
    assert 0.2 < picture.alpha.mean() < 0.8
    inner = face.image.normal[..., 2] > 0.97
    inner &= face.mask & np.roll(face.mask, 3, 0) & np.roll(face.mask, -3, 0)
    pixels, _ = project(camera, face.image.position[inner])
    seen = picture.linear[tuple(np.rint(pixels).astype(int).T[::-1])]
    expected = relit.texture_linear[inner]
    assert np.median(np.abs(seen - expected).max(1) / expected.max(1)) < 0.05
    turned = relit.picture(default_camera(face, shape, azimuth_rad=1.2), shape=shape, samples=1)
    assert turned.alpha.mean() < picture.alpha.mean()


def test_supersampling_keeps_picture_and_input_and_softens_the_edge(person):
    face = person(0)
    before = deepcopy(face)
    relit = relight(face, [light_at(20, 20)])
    hard, soft = (relit.picture(shape=(64, 64), samples=n) for n in (1, 3))
    assert_array_equal(face.albedo_linear, before.albedo_linear)
    assert_array_equal(face.image.position, before.image.position)
    assert set(np.unique(hard.alpha)) == {0, 1}
    assert len(np.unique(soft.alpha)) > 5
    assert abs(hard.alpha.mean() - soft.alpha.mean()) < 0.01
    inside = (hard.alpha == 1) & (soft.alpha == 1)
    assert np.median(np.abs(hard.linear - soft.linear)[inside]) < 0.01


def test_the_glb_shines_by_itself_and_keeps_its_place(person, tmp_path):
    face = person(0)
    relight(face, [light_at(20, 20)]).write_glb(tmp_path / "relit.glb")
    mesh = trimesh.load(tmp_path / "relit.glb", force="mesh", process=False)
    assert_allclose(mesh.vertices * 1000, face.mesh.vertices, atol=1e-3)
    assert mesh.visual.material.emissiveTexture is not None
    assert list(mesh.visual.material.baseColorFactor)[:3] == [0, 0, 0]


@pytest.mark.parametrize("azimuth", [20, 60])
def test_a_coarse_chart_is_not_shaded_by_the_finer_surface_it_stands_for(azimuth):
    """A ball of 24 x 24 texels inside the true one: it is convex, so nothing shades it."""
    scene, ball = hemisphere(size=24), trimesh.creation.icosphere(5, 80.0)
    image = replace(scene.image, occluder=(ball.vertices, ball.faces))
    face, lamp = ProcessedFace.of("ball", image, np.ones((24, 24, 3))), [light_at(azimuth)]
    bare = replace(face, casts_shadows=False)
    pictures = (relight(one, lamp).picture(shape=(64, 64), samples=1).linear for one in (face, bare))
    assert_array_equal(*pictures)


@pytest.mark.parametrize(
    ("call", "options", "words"),
    [
        (relight, {"ambient": np.nan}, "ambient"),
        (relight, {"ambient": -0.1}, "not negative"),
        (relight, {"ambient": np.inf}, "finite"),
        (relight, {"environment_linear": np.ones((4, 8))}, "environment_linear"),
        (replace, {"view_direction": (0, 0, 0)}, "view_direction"),
        (replace, {"view_direction": (np.nan, 0, 1)}, "finite"),
        (replace, {"albedo_linear": np.ones((4, 4, 3))}, "albedo is"),
        (replace, {"expected_error": np.zeros((3, 3))}, "expected_error is"),
        (default_camera, {"elevation_rad": np.pi / 2}, "elevation"),
        (default_camera, {"azimuth_rad": np.nan}, "azimuth"),
        (lambda face: relight(face).picture(samples=0), {}, "1 sample or more"),
        (lambda face: relight(face).picture(shape=(8, 8)).srgb(-1), {}, "exposure is -1"),
        (lambda face: RelightOptions(gloss="much"), {}, "gloss is 'much'"),
    ],
)
def test_misuse_is_told(person, call, options, words):
    with pytest.raises((ApplicationError, ValueError), match=words):
        call(person(0), **options)


def test_a_face_without_a_highlight_gets_skins_usual_one_and_says_so(person):
    matte, glossy = replace(person(0), reflectance=Reflectance("lambert")), person(0)

    def lit(face, gloss="auto"):
        return relight(face, [light_at(20, 20)], options=RelightOptions(gloss=gloss))

    usual, found = lit(matte), lit(matte, "found")
    assert usual.specular.max() > 0.05 * matte.level()
    assert found.specular.max() == 0
    assert ("usual" in usual.notes[0], found.notes) == (True, ())
    assert_allclose(usual.diffuse, found.diffuse)
    assert lit(glossy).face.reflectance == glossy.reflectance
    assert lit(glossy, "none").specular.max() == 0
    assert lit(replace(matte, model_name="none")).specular.max() == 0


def test_hair_has_no_gloss(person):
    matte = replace(person(0), reflectance=Reflectance("lambert"))
    rows = np.indices(matte.mask.shape)[0]

    def highlight(first_row_of_skin):
        skin = np.where(matte.mask & (rows >= first_row_of_skin), 1.0, 0.0)
        face = replace(matte, image=replace(matte.image, skin=skin))
        return relight(face, [light_at(0, 60)]).specular[:14].max()

    assert highlight(20) < 0.1 * highlight(0)


def test_the_edge_of_a_soft_shadow_has_no_steps():
    """A square before a wall: the light changes by a few percent from texel to texel of its edge at most."""
    corners, faces = grid(2, 2)
    x, toward = np.linspace(40, 60, 400), np.array([0.0, 0, 1])
    caster = RayCaster(100 * corners + [-50, -50, 40], faces)
    shadows = ShadowMap(caster, x[:, None] * [1, 0, 0], np.tile(toward, (400, 1)))
    coarse, fine = (shadows.reached(toward, np.inf, 8.0, points) for points in (16, 96))
    # The part of a disc beyond a chord at distance d from its middle, all in radii.
    d = np.clip((50 - x) / (40 * np.tan(np.deg2rad(8.0))), -1, 1)
    true = (np.arccos(d) - d * np.sqrt(1 - d**2)) / np.pi
    assert np.abs(fine - true).max() < 0.035
    assert np.abs(np.diff(fine)).max() < 0.035 < np.abs(np.diff(coarse)).max()
