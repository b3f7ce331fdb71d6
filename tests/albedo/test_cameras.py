"""Highlights of a texture that two cameras took: where each of them stood, not where one viewer would."""

from dataclasses import replace

import numpy as np
import pytest

from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.core.geometry_image import NO_CAMERA
from scan2albedo.synthetic import Material, face, light_at
from scan2albedo.synthetic.renderer import RayScene, render

PLACES = np.array([[570.0, 90.0, 815.0], [-570.0, 90.0, 815.0]])


@pytest.fixture(scope="module")
def two_pods():
    """A face that two pods took; its left half one of them, its right half the other: (image, albedo)."""
    plain = face(0, texture="skin", size=128, lights=[light_at(-32, 18, intensity=2.5)])
    image, mask = plain.image, plain.image.mask
    camera = np.where(image.position[..., 0] > 0, 0, 1).astype(np.uint8)
    image = replace(image, camera=np.where(mask, camera, NO_CAMERA), camera_positions=PLACES)
    lit = render(
        image.position[mask],
        image.normal[mask],
        plain.albedo_linear[mask],
        plain.lights,
        material=Material(0.3, 0.12, 14.0),
        occluder=RayScene(*image.occluder_mesh()),
        view_direction=image.toward_camera((0, 0, 1)),
        specular_scale=1.0 if image.specular_scale is None else image.specular_scale[mask],
    )
    texture = np.zeros((*mask.shape, 3), np.float32)
    texture[mask] = lit.radiance_linear / lit.radiance_linear.max() * 0.9
    return replace(image, texture_linear=texture), plain.albedo_linear


@pytest.fixture(scope="module")
def known(two_pods):
    return estimate_albedo(two_pods[0], 1)


def error(estimate, albedo):
    return albedo_error(estimate.albedo_linear, albedo, estimate.image.mask).mse_percent


def row(estimate):
    (found,) = [step for step in estimate.plan if step.stage == "albedo.cameras"]
    return found


def test_highlights_of_two_cameras_are_taken_off_without_a_seam(two_pods, known):
    image, albedo = two_pods
    blind = estimate_albedo(image, 1, options=EstimateOptions(skip=("albedo.cameras",)))
    assert error(known, albedo) < 0.045
    assert error(known, albedo) < 0.8 * error(blind, albedo)
    assert row(known).ran
    assert "2 camera(s) took 100.0 %" in row(known).evidence
    assert known.parameters["specular_exponent"] == pytest.approx(14, rel=0.2)
    assert not row(blind).ran
    assert known.image.camera is not None
    assert blind.image.camera is None


def test_relit_shows_what_one_viewer_sees(two_pods, known):
    image, _ = two_pods
    one_viewer = replace(known, image=replace(image, camera=None, camera_positions=None))
    lamps = [light_at(20, 10)]
    assert np.array_equal(known.relit(lamps), one_viewer.relit(lamps))


def test_cameras_say_nothing_of_a_matt_surface():
    scene = face(0, texture="skin", size=64, lights=[light_at(30, 10)], material=Material(0.0, 0.0))
    camera = np.zeros(scene.image.shape, np.uint8)
    image = replace(scene.image, camera=camera, camera_positions=PLACES[:1])
    estimate = estimate_albedo(
        image, 1, options=EstimateOptions(skip=("albedo.roughness", "albedo.specular"))
    )
    assert not row(estimate).ran
    assert "from everywhere" in row(estimate).reason
    assert not row(estimate_albedo(scene.image, 1)).ran


def test_the_papers_search_has_one_viewer(two_pods):
    options = EstimateOptions(objective="albedo-deviation")
    estimate = estimate_albedo(two_pods[0], 1, budget=0.5, options=options)
    assert estimate.image.camera is None
