"""The paper's tables: what is measured, over which scenes, and how it is shown."""

from dataclasses import replace

import numpy as np
import pytest

from scan2albedo.pipeline import validation
from scan2albedo.pipeline.validation import (
    LightingRow,
    LightingTable,
    ValidationRow,
    ValidationTable,
    angle_between_deg,
    mean_deviation_percent,
    validate_lighting,
    validate_scenes,
    validation_row,
)
from scan2albedo.synthetic import Material, hemisphere, light_at


def test_a_hemisphere_is_measured_against_its_truth():
    scene = hemisphere(lights=[light_at(30)], size=96, material=Material(sigma_rad=0.0))
    measured = validation_row(scene, 30.0, "lambert")
    assert measured.texture == "wood"
    assert measured.input_mse_percent > 1
    assert measured.mse_percent < 0.05
    assert measured.value_mse_percent < 0.1
    assert measured.light_error_deg < 5
    assert measured.light_count >= 1


ROW = ValidationRow(30.0, "wood", "lambert", 5.0, 0.02, 0.03, 0.01, 0.5, 1)


def test_scenes_cover_every_light_texture_and_reflectance(monkeypatch):
    asked = []

    def recorded(scene, angle, brdf):
        asked.append((brdf, scene.texture, angle))
        assert np.rad2deg(scene.lights[0].azimuth_rad) == pytest.approx(angle)
        return replace(ROW, light_angle_deg=angle, brdf=brdf)

    monkeypatch.setattr(validation, "validation_row", recorded)
    progress = []
    table = validate_scenes("hemisphere", size=16, on_row=progress.append)
    assert len(table.rows) == len(set(asked)) == 12
    assert tuple(progress) == table.rows
    assert {angle for _, _, angle in asked} == {0.0, 30.0, 60.0}
    assert table.paper_mse_percent == 1.07
    assert validate_scenes("face", size=16).paper_mse_percent == 2.01


def test_the_worst_row_and_channel_count():
    rows = ROW, replace(ROW, mse_percent=0.5), replace(ROW, value_mse_percent=0.7)
    assert ValidationTable("face", rows, 2.01).worst_mse_percent == 0.7


def test_angles_between_lights():
    weak, strong = light_at(80, 0, intensity=0.1), light_at(10, 0, intensity=2.0)
    assert angle_between_deg([weak, strong], light_at(-20)) == pytest.approx(30)
    assert angle_between_deg([], light_at(0)) == 180


def test_deviation_over_lights_by_hand():
    images = [np.array([0.2, 0.4]), np.array([0.4, 0.2])]
    assert mean_deviation_percent(images, 0.3) == pytest.approx(10.0)
    assert mean_deviation_percent([5 * images[0], images[1]], 0.3) == pytest.approx(10.0)
    assert mean_deviation_percent([images[0], 7 * images[0]], 0.3) == pytest.approx(0.0, abs=1e-12)


def test_tables_show_our_figures_beside_the_papers():
    text = ValidationTable("face", (ROW, replace(ROW, light_angle_deg=60.0)), 2.01).text()
    assert "worst: 0.0300 %   the paper: 2.01 %" in text
    assert "60°" in text
    assert len({len(line) for line in text.splitlines()[1:-1]}) == 1
    lighting = LightingTable((LightingRow(1, 12.0, 2.0), LightingRow(2, 10.0, 3.0)))
    assert lighting.mean.texture_std_percent == 11.0
    assert lighting.mean.albedo_std_percent == 2.5
    for figure in ("11.00 %", "4.00 %", "2.50 %"):
        assert figure in lighting.text()


@pytest.mark.slow
def test_hemispheres_stay_below_a_tenth_of_a_percent():
    assert validate_scenes("hemisphere").worst_mse_percent <= 0.1


@pytest.mark.slow
def test_faces_stay_below_a_fifth_of_a_percent():
    assert validate_scenes("face").worst_mse_percent <= 0.2


@pytest.mark.slow
def test_albedo_depends_on_light_less_than_the_papers():
    table = validate_lighting()
    assert table.mean.texture_std_percent > 8
    assert table.mean.albedo_std_percent < 4
