"""Highlights of a texture that two cameras took: where each of them stood, not where one viewer would."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lit_scenes import percent_off, plan_row, render

from scan2albedo.albedo import EstimateOptions, estimate_albedo
from scan2albedo.core.geometry_image import NO_CAMERA
from scan2albedo.synthetic import Material, face, light_at
from scan2albedo.synthetic.renderer import RayScene

PLACES = np.array([[570.0, 90.0, 815.0], [-570.0, 90.0, 815.0]])


@pytest.fixture(scope="module")
def two_pods():
    """A face that two pods took; its left half one of them, its right half the other."""
    plain = face(0, texture="skin", size=128)
    mask = plain.image.mask
    camera = np.where(mask, plain.image.position[..., 0] <= 0, NO_CAMERA).astype(np.uint8)
    image = replace(plain.image, camera=camera, camera_positions=PLACES)
    texture = render(
        (image.position, image.normal, mask),
        plain.albedo_linear,
        [(-32, 18, 2.5)],
        material=Material(0.3, 0.12, 14.0),
        bits=None,
        occluder=RayScene(*image.occluder_mesh()),
        view_direction=image.toward_camera((0, 0, 1)),
        specular_scale=image.specular_scale[mask],
    )
    return replace(plain, image=replace(image, texture_linear=texture))


@pytest.fixture(scope="module")
def known(two_pods):
    return estimate_albedo(two_pods.image, 1)


@pytest.mark.slow
def test_highlights_of_two_cameras_are_taken_off_without_a_seam(two_pods, known):
    blind = estimate_albedo(two_pods.image, 1, options=EstimateOptions(skip=("albedo.cameras",)))
    assert percent_off(known, two_pods) < 0.045
    assert percent_off(known, two_pods) < 0.8 * percent_off(blind, two_pods)
    assert plan_row(known, "cameras").ran
    assert "2 camera(s) took 100.0 %" in plan_row(known, "cameras").evidence
    assert known.parameters["specular_exponent"] == pytest.approx(14, rel=0.2)
    assert not plan_row(blind, "cameras").ran
    assert known.image.camera is not None
    assert blind.image.camera is None


def test_relit_shows_what_one_viewer_sees(two_pods, known):
    one_viewer = replace(known, image=replace(two_pods.image, camera=None, camera_positions=None))
    lamps = [light_at(20, 10)]
    assert np.array_equal(known.relit(lamps), one_viewer.relit(lamps))


def test_cameras_say_nothing_of_a_matt_surface():
    scene = face(0, texture="skin", size=64, lights=[light_at(30, 10)], material=Material(0.0, 0.0))
    camera = np.zeros(scene.image.shape, np.uint8)
    image = replace(scene.image, camera=camera, camera_positions=PLACES[:1])
    estimate = estimate_albedo(
        image, 1, options=EstimateOptions(skip=("albedo.roughness", "albedo.specular"))
    )
    assert not plan_row(estimate, "cameras").ran
    assert "from everywhere" in plan_row(estimate, "cameras").reason
    assert not plan_row(estimate_albedo(scene.image, 1), "cameras").ran


def test_the_papers_search_has_one_viewer(two_pods):
    options = EstimateOptions(objective="albedo-deviation")
    estimate = estimate_albedo(two_pods.image, 1, budget=0.5, options=options)
    assert estimate.image.camera is None
