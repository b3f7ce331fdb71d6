"""Photographs of synthetic people in plain light hold what they say."""

import numpy as np
import pytest
from helpers.measures import rms
from numpy.testing import assert_allclose
from worlds.environments import generated_environment

from scan2albedo.geometry.pinhole import project
from scan2albedo.lighting.harmonics import project_environment
from scan2albedo.reflectance import (
    VertexReflectance,
    observe_photograph,
)
from scan2albedo.synthetic import Portrait, face_photograph

CLEAN = Portrait(picture_size=160, noise=0.0, bits=None, saturated_part=0.0)


@pytest.fixture(scope="module")
def environment():
    return generated_environment(3)


@pytest.fixture(scope="module")
def taken(environment):
    how = {"azimuth_deg": 15, "lights": 200, "landmark_noise_px": 0.0, "hair": False, "portrait": CLEAN}
    return face_photograph(2, environment, **how)


@pytest.mark.slow
def test_colours_at_vertices_are_those_of_harmonics_with_shadows(taken, environment):
    """Rays to 200 lights against harmonics of order 8 with the transfer of the mesh: code of two kinds."""
    seen = observe_photograph(
        taken.image,
        taken.camera,
        taken.vertices,
        taken.faces,
        normals=taken.normals,
        mask=taken.skin,
        gamma=taken.portrait.gamma,
        saturation=2.0,
    )
    truth = VertexReflectance(taken.diffuse_linear, taken.weights, np.ones(len(taken.vertices), bool))
    shaded = seen.transfer.shade(truth, project_environment(environment)).radiance_linear
    used = np.asarray(seen.seen)
    error = np.abs(np.asarray(seen.observed_linear) / taken.exposure - shaded)[used]
    scale = rms(shaded[used])
    assert used.sum() > 2000
    assert np.median(error) < 0.02 * scale
    assert np.percentile(error, 90) < 0.1 * scale


def test_labels_are_where_the_landmarks_are(taken):
    pixels, _ = project(taken.camera, taken.landmarks)
    seen = np.isfinite(taken.landmarks_px).all(1)
    assert 40 < seen.sum() < 68
    assert_allclose(taken.landmarks_px[seen], pixels[seen])


def test_the_sensor_stores_eight_bits_with_noise(environment):
    portrait = Portrait(noise=0.02, picture_size=64, saturated_part=0.05)
    taken = face_photograph(2, environment, lights=8, hair=False, portrait=portrait)
    assert taken.image.dtype == np.uint8
    assert 0.01 < (taken.image[taken.skin] == 255).any(-1).mean() < 0.2


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"lights": 0}, "lights is 0"),
        ({"elevation_deg": 90.0}, "nowhere"),
        ({"landmark_noise_px": float("nan")}, "landmark_noise_px"),
    ],
)
def test_arguments_out_of_range_are_refused(change, told, environment):
    with pytest.raises(ValueError, match=told):
        face_photograph(0, environment, **change)


def test_maps_that_are_none_are_refused():
    with pytest.raises(ValueError, match="environment"):
        face_photograph(0, np.full((4, 8, 3), np.nan))
