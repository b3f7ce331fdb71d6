"""Brows, eyes and lips in the scan's colours are found, and nothing where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from scan2albedo import fit
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.painted_features import painted_features, painted_pull
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.synthetic import raw_scan

WITHIN_MM = {"brow": 2.0, "eye": 1.5, "lips": 1.2}
LIPS = slice(48, 68)


@pytest.fixture(scope="module")
def person(fine_scan):
    return fine_scan


def found_at(scan, truth, shift=(0.0, 0.0, 0.0)):
    return painted_features(scan, truth.model_from_scan, truth.landmarks + shift)


@pytest.mark.parametrize("shift", [(0, 0, 0), (1, 3, 0), (-1, -3, 0)], ids=str)
def test_features_are_found_from_beside(person, shift):
    scan, truth = person
    found = found_at(scan, truth, shift)
    assert sorted(feature.name for feature in found) == ["brow", "brow", "eye", "eye", "lips"]
    for feature in found:
        off = (feature.places - truth.landmarks[list(feature.numbers), :2])[:, 1]
        assert np.sqrt(np.mean(off**2)) < WITHIN_MM[feature.name], feature.name
        assert (feature.sigma_mm > 0.5).all()
        assert (feature.sigma_mm < 4.0).all()


def test_both_sides_are_found_by_themselves(person):
    scan, truth = person
    moved = truth.landmarks.copy()
    moved[42:48, 1] += 2.0  # the left eye's landmarks alone stand too high
    places = {
        f.numbers[0]: f.places[:, 1].mean() for f in painted_features(scan, truth.model_from_scan, moved)
    }
    right, left = (truth.landmarks[first : first + 6, 1].mean() for first in (36, 42))
    assert abs(places[36] - right) < 1.5
    assert abs(places[42] - left) < 1.5


def grey(texture):
    return np.repeat(texture.mean(-1, keepdims=True), 3, axis=-1)


def test_grey_pictures_show_them_too(person):
    scan, truth = person
    names = {
        f.name for f in found_at(replace(scan, texture_linear=grey(scan.texture_linear)), truth, (0, 2, 0))
    }
    assert "brow" in names


def even(texture):
    return np.full_like(texture, 0.3)


def black(texture):
    return np.zeros_like(texture)


def noise(texture):
    return np.random.default_rng(0).uniform(0.2, 0.4, texture.shape).astype(np.float32)


def sideways_light(texture):
    across = np.linspace(0.1, 0.6, texture.shape[1], dtype=np.float32)
    return np.broadcast_to(across[None, :, None], texture.shape).copy()


@pytest.mark.parametrize("paint", [even, black, noise, sideways_light])
def test_without_features_nothing_is_said(person, paint):
    scan, truth = person
    assert found_at(replace(scan, texture_linear=paint(scan.texture_linear)), truth) == []


@pytest.mark.parametrize("toward", [(0, 0.95, 0.3), (0, -0.8, 0.6), (0.7, 0.6, 0.4)], ids=str)
def test_a_lamp_on_an_even_face_is_no_feature(person, toward):
    scan, truth = person
    normals = vertex_normals(scan.vertices, scan.faces) @ truth.model_from_scan[:3, :3].T
    light = 0.08 + np.maximum(normals @ np.array(toward), 0)
    shaded = replace(
        scan, uv=None, texture_linear=None, vertex_color_linear=light[:, None] * (0.8, 0.55, 0.45)
    )
    assert found_at(shaded, truth) == []


def test_a_few_hot_texels_change_little(person):
    scan, truth = person
    hot = scan.texture_linear.copy()
    hot[np.random.default_rng(0).uniform(size=hot.shape[:2]) < 1e-4] = 1e6
    before, after = found_at(scan, truth), found_at(replace(scan, texture_linear=hot), truth)
    assert [f.name for f in before] == [f.name for f in after]
    for one, other in zip(before, after, strict=True):
        assert np.abs(one.places - other.places).max() < 0.5


def test_nothing_is_said_without_colour_or_far_away(person, model):
    scan, truth = person
    plain = replace(scan, uv=None, texture_linear=None)
    assert painted_pull(plain, truth.model_from_scan, model, model.control_vertices) is None
    assert found_at(scan, truth, (0.0, 400.0, 0.0)) == []
    bare = replace(model, landmark_points=None)
    assert painted_pull(scan, truth.model_from_scan, bare, model.control_vertices) is None


def test_brows_pull_up_and_down_alone(person, model):
    scan, truth = person
    pull = painted_pull(scan, truth.model_from_scan, model, truth.control_points)
    assert isinstance(pull, LandmarkPull)
    assert pull.painted == len(pull.numbers) == 42
    assert pull.openings == 0
    sideways, up, forward = pull.axes.sum(0)
    assert (sideways, up, forward) == (32, 42, 0)


@pytest.mark.slow
def test_the_fit_follows_lips(model):
    """A smile moves lips along the face, which shape alone hardly shows."""
    scan, truth = raw_scan(45, expression="smile")
    pose = truth.model_from_scan
    errors = {}
    for colors in (True, False):
        fitted = fit(scan, model, pose, options=FitOptions(colors=colors))
        found = transform_points(pose @ invert_rigid(fitted.model_from_scan), fitted.landmarks)[LIPS]
        errors[colors] = np.linalg.norm(found - truth.landmarks[LIPS], axis=1).mean()
        assert bool(fitted.metrics["painted_landmarks"]) == colors
    assert errors[True] < 0.75 * errors[False]
