"""How albedo is judged on the traced set, on scenes made here; the set itself lies outside the repository."""

from dataclasses import replace

import numpy as np
import pytest
from bench.judging import (
    VARIABLE,
    ScanTruth,
    load_flashes,
    load_image,
    received,
    scene_names,
    score,
    simple_peers,
    traced_folder,
)
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.synthetic import face, hemisphere, light_at


def test_without_the_variable_there_is_no_set(monkeypatch, tmp_path):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert traced_folder() is None
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert traced_folder() is None
    (tmp_path / "soft_dome_x.npz").write_bytes(b"")
    assert traced_folder() == tmp_path
    assert scene_names(tmp_path, "images") == ["soft_dome_x"]
    assert scene_names(tmp_path, "scans") == []


def test_a_scene_is_read_as_it_was_written(tmp_path):
    image = hemisphere(size=16).image
    vertices, faces = image.occluder_mesh()
    np.savez(
        tmp_path / "geometry_ball.npz",
        position_mm=image.position.astype(np.float32),
        normal=image.normal.astype(np.float32),
        mask=image.mask,
        occluder_vertices=vertices,
        occluder_faces=faces.astype(np.uint32),
    )
    np.savez(
        tmp_path / "soft_dome_ball.npz",
        texture_srgb8=np.full((16, 16, 3), 188, np.uint8),
        albedo_linear=np.full((16, 16, 3), 0.5, np.float16),
        mask=image.mask,
        geometry="ball",
    )
    read = load_image(tmp_path, "soft_dome_ball")
    assert read.lamps == []
    assert_allclose(read.image.texture_linear[image.mask], 0.503, atol=1e-3)
    assert_array_equal(read.albedo_linear[image.mask], 0.5)
    assert_array_equal(read.image.occluder_mesh()[1], faces)


def test_the_score_does_not_care_for_one_scale_but_for_color():
    truth, judged = np.random.default_rng(0).uniform(0.2, 0.6, (8, 8, 3)), np.ones((8, 8), bool)
    assert score(3 * truth, truth, judged).color_mse == pytest.approx(0, abs=1e-12)
    assert score(truth * [1.3, 1, 0.7], truth, judged).color_mse > 0.5


def test_the_score_tells_what_half_and_most_of_the_texels_err_by():
    truth = np.full((10, 10, 3), 0.5)
    estimate = truth.copy()
    estimate[0] *= 1.5
    found = score(estimate, truth, np.ones((10, 10), bool))
    scale = (0.9 + 0.1 * 1.5) / (0.9 + 0.1 * 1.5**2)
    assert found.half == pytest.approx(100 * (1 - scale))
    assert found.most == pytest.approx(100 * (1.5 * scale - 1))
    assert found.rmse == pytest.approx(100 * np.sqrt(found.mse / 100) / 0.5)


def test_occlusion_and_transfer_of_a_convex_shape_are_those_of_the_open():
    image = hemisphere(size=24).image
    light = received(image)
    front = image.normal[image.mask][:, 2] > 0.6
    assert_allclose(light.open_part[front], 1, atol=0.08)
    assert_allclose(light.shadowed[front], light.plain[front], atol=0.05)


def test_harmonics_take_off_a_soft_light_and_each_channel_its_own():
    scene = hemisphere(size=32, texture="plain", lights=[light_at(30, intensity=1.0)], bits=None)
    truth, mask = scene.albedo_linear.astype(float), scene.image.mask
    image = replace(scene.image, texture_linear=scene.image.texture_linear * np.float32([1.0, 0.8, 0.6]))
    scores = {name: score(albedo, truth, mask) for name, albedo in simple_peers(image).items()}
    assert scores["SH"].mse < 0.3 * scores["as is"].mse
    assert scores["SH+shadows"].mse < 0.5 * scores["as is"].mse
    assert set(scores) == {"as is", "AO", "SH", "SH+shadows"}


def test_the_truth_of_a_scan_is_looked_up_on_its_surface():
    albedo = np.reshape([0.1, 0.2, 0.3, 0.4], (2, 2, 1)) * np.ones(3)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    truth = ScanTruth(10 * corners, np.array([[0, 1, 2]]), corners[None, :, :2], albedo, np.eye(4), 1.0, 0)
    points = np.array([[0.5, 0.5, 1.0], [9, 0.5, 0], [0.5, 9, 0]])
    found, distance = truth.at(points)
    assert_allclose(found[:, 0], [0.3, 0.4, 0.1])
    assert_allclose(distance, [1, 0, 0], atol=1e-6)
    partly = replace(truth, valid=albedo[..., 0] > 0.1)
    assert_allclose(partly.at(points)[0][:, 0], [0.3, 0.4, np.nan])


def test_flashes_count_where_they_explain_a_texel(tmp_path):
    normal = np.tile(np.float32([0, 0, 1]), (4, 4, 1))
    code = np.full((1, 4, 4), round(255 * 1.06 * 0.5), np.uint8)
    code[0, 0] = 20
    np.savez(
        tmp_path / "yaleB01.npz",
        position_mm=normal,
        normal=normal,
        mask=np.ones((4, 4), bool),
        albedo=np.full((4, 4), 0.5, np.float32),
        lights=np.array(["A+000"]),
        direction=np.float32([[0, 0, 1]]),
        strength=np.float32([1]),
        texture_linear8=code,
    )
    (name,) = scene_names(tmp_path, "flashes")
    (scene,) = load_flashes(tmp_path, name)
    assert scene.name == "yaleB01_A+000"
    assert_array_equal(scene.judged, code[0] > 20)
    assert scene.albedo_linear.shape == (4, 4, 3)


def test_shadows_of_a_face_are_in_the_transfer():
    image = face(0, size=48).image
    light = received(image)
    assert light.open_part.min() < 0.6
    assert (light.plain[:, 0] >= light.shadowed[:, 0] - 1e-9).all()
