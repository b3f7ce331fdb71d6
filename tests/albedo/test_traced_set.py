"""Ceilings on the path-traced set that S2A_TRACED names: rooms and skies that nothing here rendered."""

import pytest
from bench.judging import VARIABLE, calibration, load_image, scene_names, score, traced_folder

import scan2albedo as s2a

FOLDER = traced_folder()
NAMES = [] if FOLDER is None else scene_names(FOLDER, "images")
CEILINGS = {
    "dome": 0.15,
    "sky": 0.25,
    "softboxes6": 0.25,
    "softboxes2": 0.3,
    "softbox_side": 0.25,
    "window": 0.25,
    "ring": 0.2,
    "lamp_room": 0.25,
    "flash": 0.25,
    "flash_near": 0.6,
    "flashes2": 0.25,
    "sun": 1.7,
}
"""MSE of V in percent that neither of two people's albedo may exceed."""
LEAST_INSIDE = {"soft_softboxes2_ben": 0.35}
"""Part of the texels that err by no more than is expected, where it is not most: a lamp is out of place."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(FOLDER is None, reason=f"{VARIABLE} names no folder made by python tools/worlds"),
]


@pytest.mark.parametrize("name", NAMES or ["the set"])
def test_the_albedo_stays_below_its_ceiling(name):
    scene = load_image(FOLDER, name)
    light = name.removeprefix("soft_").rsplit("_", 1)[0]
    estimate = s2a.estimate_albedo(scene.image, seed=0)
    error = score(estimate.albedo_linear.astype(float), scene.albedo_linear, scene.judged)
    assert error.mse < CEILINGS[light]
    said = estimate.expected_error
    inside, within = calibration(
        estimate.albedo_linear.max(2), scene.albedo_linear.max(2), said, scene.judged
    )
    assert inside > LEAST_INSIDE.get(name, 0.55), "fewer texels than said err by less than is expected"
    assert within > 0.8
