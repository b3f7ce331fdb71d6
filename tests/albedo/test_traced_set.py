"""Ceilings on the path-traced set, all or some of it: rooms and skies that nothing here rendered."""

import pytest
from bench.judging import calibration, load_image, scene_names, score, traced_folder

import scan2albedo as s2a

FOLDER = traced_folder()
SHARED = ["soft_dome", "soft_sky", "soft_softboxes6", "soft_window"]
"""Those of the shared data, taken where S2A_TRACED names no folder made by python tools/worlds."""
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


@pytest.mark.slow
@pytest.mark.parametrize("name", scene_names(FOLDER, "images") if FOLDER else SHARED)
def test_the_albedo_stays_below_its_ceiling_and_errs_as_expected(name, request):
    scene = load_image(FOLDER or request.getfixturevalue("shared_data") / "traced", name)
    light = name.removeprefix("soft_").rsplit("_", 1)[0]
    estimate = s2a.estimate_albedo(scene.image, seed=0)
    error = score(estimate.albedo_linear.astype(float), scene.albedo_linear, scene.judged)
    assert error.mse < CEILINGS[light]
    said = estimate.expected_error
    inside, within = calibration(
        estimate.albedo_linear.max(2), scene.albedo_linear.max(2), said, scene.judged
    )
    assert inside > LEAST_INSIDE.get(name, 0.6 if name in SHARED else 0.55), (
        "it errs by more than is expected"
    )
    assert within > (0.9 if name in SHARED else 0.8)
