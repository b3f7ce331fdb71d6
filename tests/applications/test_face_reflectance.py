"""Processed scans as reflectances of the model's vertices: albedo, highlights, units, what was not seen."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.processed_faces import person_scene
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import (
    FaceMesh,
    ProcessedFace,
    RelightOptions,
    load_result,
    reflectance_of_processed,
    relight,
)
from scan2albedo.applications.face_reflectance import sampled_at_vertices
from scan2albedo.core import PointLight
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.reflectance import (
    lobe_weights_of_phong,
    point_light_lobes,
    point_light_radiance,
)
from scan2albedo.synthetic.textures import paint_face

pytestmark = pytest.mark.slow

SIZE = 128
FAR_MM = 1e7
MATTE = Reflectance("lambert")
GLOSSY = Reflectance("lambert", 0.0, 0.15, 8.0)
ROUGH = Reflectance("oren-nayar", 0.3)
LIGHTS = [PointLight(0.0, 0.0), PointLight(0.6, 0.3), PointLight(-0.4, 0.2, 900.0, 2.5)]


@pytest.fixture(scope="module")
def true_face(model):
    """A synthetic face on the default model's mesh, as a processed scan has it."""
    made = person_scene(1, size=SIZE)
    vertices, faces = made.image.occluder_mesh()
    level = round(np.log(len(faces) / len(model.control_faces)) / np.log(4))
    mesh = FaceMesh(vertices, faces, model.refined_uv(level))
    return ProcessedFace("someone", made.image, made.albedo_linear, MATTE, made.lights, mesh, "default")


def test_the_albedo_of_texels_is_that_of_vertices(true_face, model):
    truth = paint_face(true_face.mesh.uv, model, np.random.default_rng(1))
    found = reflectance_of_processed(true_face)
    assert found.mesh is true_face.mesh
    assert found.reflectance.known.all()
    albedo = found.reflectance.diffuse_linear
    scale = np.sum(albedo * truth) / np.sum(albedo**2)
    # What is left are the edges of brows and lips between 128 x 128 texels.
    assert np.linalg.norm(scale * albedo - truth) < 0.065 * np.linalg.norm(truth)


def sent_and_expected(face, light, reflectance):
    """(N, 3) what vertices send under one light, as a reflectance has it and as the relit face has it."""
    options = RelightOptions(gloss="found", fill_gaps=False)
    bare = replace(face, casts_shadows=False)
    picture = relight(bare, [light], ambient=0.0, options=options).texture_linear
    expected, known = sampled_at_vertices(picture.astype(float), face)
    normals = normalized(sampled_at_vertices(face.image.normal, face)[0])
    near = np.isfinite(light.distance_mm)
    lamp = light.direction * min(light.distance_mm, FAR_MM)
    geometry = (face.mesh.vertices, normals, [[0, 0, FAR_MM]], [lamp])
    lobes = point_light_lobes(*geometry, reference_distance_mm=light.distance_mm if near else None)
    sent = np.pi * light.intensity * point_light_radiance(reflectance, lobes)[0]
    used = known & (normals[:, 2] > 0.2)
    return sent[used], expected[used]


@pytest.mark.parametrize(("skin", "most"), [(MATTE, 0.025), (GLOSSY, 0.04), (ROUGH, 0.13)])
@pytest.mark.parametrize("light", LIGHTS)
def test_it_sends_what_the_relit_face_sends(true_face, light, skin, most):
    face = replace(true_face, reflectance=skin)
    sent, expected = sent_and_expected(face, light, reflectance_of_processed(face).reflectance)
    assert np.linalg.norm(sent - expected) < most * np.linalg.norm(expected)


def test_rough_skin_is_that_matte_skin_which_is_nearest(true_face):
    face = replace(true_face, reflectance=ROUGH)
    found = reflectance_of_processed(face).reflectance

    def error(factor):
        scaled = replace(found, diffuse_linear=factor * found.diffuse_linear)
        pairs = [sent_and_expected(face, light, scaled) for light in LIGHTS]
        return np.mean([np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in pairs])

    assert error(1.0) < min(error(0.9), error(1.1))


def test_vertices_that_were_not_seen_are_not_known_and_lend_nothing(true_face):
    seen = true_face.mask.copy()
    seen[:, : SIZE // 2] = False
    albedo = np.where(seen[..., None], true_face.albedo_linear, 1e6)
    hidden = replace(true_face, albedo_linear=albedo, image=replace(true_face.image, texture_valid=seen))
    found = reflectance_of_processed(hidden).reflectance
    beside = (true_face.mesh.uv[:, 0] - 0.5) * SIZE
    assert not found.known[beside < -1].any()
    assert found.known[beside > 1].all()
    assert np.isnan(found.diffuse_linear[~found.known]).all()
    assert found.diffuse_linear[found.known].max() <= true_face.albedo_linear.max()


def test_a_level_scales_albedo_and_highlights_alike(true_face):
    face = replace(true_face, reflectance=GLOSSY)
    plain, brighter = (
        reflectance_of_processed(face, level=level).reflectance for level in (None, 2 * face.level())
    )
    # Highlights are those of the estimate times the annotation.
    scale = sampled_at_vertices(face.image.specular_scale[..., None].astype(float), face)[0]
    assert_allclose(plain.weights, scale * lobe_weights_of_phong(0.15, 8.0))
    assert np.ptp(scale) > 0.1
    assert_allclose(brighter.diffuse_linear, 2 * plain.diffuse_linear)
    assert_allclose(brighter.weights, 2 * plain.weights)
    blind = replace(face.image, texture_valid=np.zeros_like(face.mask))
    for wrong, options, error, words in (
        ({}, {"level": 0.0}, ValueError, "level"),
        ({"model_name": "none"}, {}, ApplicationError, "without a model"),
        ({"image": blind}, {}, ApplicationError, "someone: no vertex"),
    ):
        with pytest.raises(error, match=words):
            reflectance_of_processed(replace(face, **wrong), **options)


def test_a_folder_gives_what_its_result_gives(result, stored):
    of_folder, of_result = reflectance_of_processed(stored), reflectance_of_processed(result)
    assert_array_equal(of_folder.mesh.faces, result.fitted.faces)
    ours, theirs = of_folder.reflectance, of_result.reflectance
    assert_array_equal(ours.known, theirs.known)
    assert_allclose(ours.diffuse_linear, theirs.diffuse_linear, rtol=1e-4)
    assert_array_equal(reflectance_of_processed(load_result(stored)).reflectance.weights, ours.weights)
