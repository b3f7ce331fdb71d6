"""Brows, eyes and lips in the scan's colours are found, and nothing where there is none."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.measures import row_lengths
from scipy.interpolate import interp1d
from scipy.spatial import cKDTree

from scan2albedo import fit, load_scan, register
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.painted_features import painted_features, painted_pull
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.synthetic import raw_scan

WITHIN_MM = {"brow": 2.0, "eye": 1.5, "lips": 1.2}
LIPS = slice(48, 68)


def found_at(person, shift=(0.0, 0.0, 0.0), **changes):
    """Return the features of a person that are found from beside, fields of the scan changed."""
    scan, truth = person
    return painted_features(replace(scan, **changes), truth.model_from_scan, truth.landmarks + shift)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [(0, 0, 0), (1, 3, 0), (-1, -3, 0)], ids=str)
def test_features_are_found_from_beside(fine_scan, shift):
    _, truth = fine_scan
    found = found_at(fine_scan, shift)
    assert sorted(side.name for side, _, _ in found) == ["brow", "brow", "eye", "eye", "lips"]
    for side, places, sigma_mm in found:
        off = (places - truth.landmarks[list(side.numbers), :2])[:, 1]
        assert np.sqrt(np.mean(off**2)) < WITHIN_MM[side.name], side.name
        assert (sigma_mm > 0.5).all()
        assert (sigma_mm < 4.0).all()


def test_both_sides_are_found_by_themselves(fine_scan):
    _, truth = fine_scan
    too_high = np.zeros((68, 3))
    too_high[42:48, 1] = 2.0  # the left eye's landmarks alone
    places = {f.numbers[0]: places[:, 1].mean() for f, places, _ in found_at(fine_scan, too_high)}
    for first in (36, 42):
        assert abs(places[first] - truth.landmarks[first : first + 6, 1].mean()) < 1.5


def test_grey_pictures_show_them_too(fine_scan):
    grey = np.repeat(fine_scan[0].texture_linear.mean(-1, keepdims=True), 3, axis=-1)
    assert "brow" in {side.name for side, *_ in found_at(fine_scan, (0, 2, 0), texture_linear=grey)}


def test_without_features_nothing_is_said(fine_scan):
    black = 0 * fine_scan[0].texture_linear
    noise = np.random.default_rng(0).uniform(0.2, 0.4, black.shape)
    sideways_light = np.linspace(0.1, 0.6, black.shape[1])[:, None]
    for brightness in (0, 0.3, noise, sideways_light):
        texture = (black + brightness).astype(np.float32)
        assert found_at(fine_scan, texture_linear=texture) == []


@pytest.mark.parametrize("toward", [(0, 0.95, 0.3), (0, -0.8, 0.6), (0.7, 0.6, 0.4)], ids=str)
def test_a_lamp_on_an_even_face_is_no_feature(fine_scan, toward):
    scan, truth = fine_scan
    normals = vertex_normals(scan.vertices, scan.faces) @ truth.model_from_scan[:3, :3].T
    light = 0.08 + np.maximum(normals @ np.array(toward), 0)
    color = light[:, None] * (0.8, 0.55, 0.45)
    found = found_at(fine_scan, uv=None, texture_linear=None, vertex_color_linear=color)
    # The shade of a ridge may look a little like a brow: what it says is too unsure to move anything.
    for side, places, sigma_mm in found:
        off = places - truth.landmarks[list(side.numbers), :2]
        assert np.abs(off.mean(axis=0)).max() < 1.0, side.name
        assert (sigma_mm > 10.0).all(), side.name


@pytest.mark.parametrize("shift", [0, 3], ids="{}mm".format)
def test_what_colours_say_fades_with_their_contrast(fine_scan, shift):
    """Features are not accepted or refused: the fainter they are, the less sure is where they lie."""
    texture = fine_scan[0].texture_linear
    even = texture.mean((0, 1))
    sure = []
    for strength in (1.0, 0.3, 0.1, 0.03, 0.0):
        faint = even + strength * (texture - even)
        found = found_at(fine_scan, (0.0, shift, 0.0), texture_linear=faint)
        sure.append(sum(np.sum(1 / sigma_mm**2) for *_, sigma_mm in found))
    assert sure[0] > 5
    assert sure == sorted(sure, reverse=True)
    assert sure[-1] == 0


def test_a_few_hot_texels_change_little(fine_scan):
    hot = fine_scan[0].texture_linear.copy()
    hot[np.random.default_rng(0).uniform(size=hot.shape[:2]) < 1e-4] = 1e6
    for one, other in zip(found_at(fine_scan), found_at(fine_scan, texture_linear=hot), strict=True):
        assert one[0].name == other[0].name
        assert np.abs(one[1] - other[1]).max() < 0.5


def test_nothing_is_said_without_colour_or_far_away(fine_scan, model):
    scan, truth = fine_scan
    plain = replace(scan, uv=None, texture_linear=None)
    assert painted_pull(plain, truth.model_from_scan, model, model.control_vertices) is None
    assert found_at(fine_scan, (0.0, 400.0, 0.0)) == []
    bare = replace(model, landmark_points=None)
    assert painted_pull(scan, truth.model_from_scan, bare, model.control_vertices) is None


def test_brows_pull_up_and_down_alone(fine_scan, model):
    scan, truth = fine_scan
    pull = painted_pull(scan, truth.model_from_scan, model, truth.control_points)
    assert pull.painted == len(pull.numbers) == 42
    assert pull.openings == 0
    assert pull.axes.sum(0).tolist() == [32, 42, 0]


@pytest.mark.slow
def test_the_fit_follows_lips(model):
    """A smile moves lips along the face, which shape alone hardly shows."""
    scan, truth = raw_scan(45, expression="smile")
    pose = truth.model_from_scan
    errors = {}
    for colors in (True, False):
        fitted = fit(scan, model, pose, options=FitOptions(colors=colors))
        found = transform_points(pose @ invert_rigid(fitted.model_from_scan), fitted.landmarks)[LIPS]
        errors[colors] = row_lengths(found - truth.landmarks[LIPS]).mean()
        assert bool(fitted.metrics["painted_landmarks"]) == colors
    assert errors[True] < 0.75 * errors[False]


def with_shut_eyes(james, landmarks):
    """Return a dark scan with lids of brown skin, and with black brows 6 mm below where they were."""
    corners = np.zeros((len(james.vertices), 2))
    corners[james.faces] = james.uv
    parts, faces = np.column_stack([james.vertices, corners]), james.faces
    for _ in range(2):
        parts, faces = trimesh.remesh.subdivide(parts, faces)[:2]
    vertices, corners = parts[:, :3], parts[:, 3:]
    pixels = pixels_from_uv(corners, james.texture_linear.shape)
    color = bilinear(james.texture_linear, pixels) * [1.15, 0.85, 0.6]
    cheek = cKDTree(vertices).query((landmarks[1] + landmarks[31]) / 2, 400)[1]
    plain = np.median(color[cheek], axis=0)
    grain = np.random.default_rng(0).normal(1, 0.04, (len(vertices), 1))

    def away(points):
        steps = np.linspace(0, len(points) - 1, 200)
        line = interp1d(range(len(points)), points, axis=0)(steps)
        return cKDTree(line).query(vertices)[0]

    for first_of_eye, first_of_brow in ((36, 17), (42, 22)):
        lids = landmarks[first_of_eye : first_of_eye + 6]
        brow = landmarks[first_of_brow : first_of_brow + 5]
        beside = away(np.array([*lids, lids[0], lids.mean(0), lids[3]]))
        for distance, half, paint in (
            (np.minimum(away(brow - [0, 2, 0]), beside), 8.0, plain),
            (away(lids[[0, 5, 4, 3]]), 0.5, 0.3 * plain),
            (away(brow - [0, 6, 0]), 5.0, np.full(3, 0.06 * plain[0])),
        ):
            cover = np.clip(1 + half - distance, 0, 1)[:, None]
            color = color * (1 - cover) + paint * grain * cover
    return replace(
        james,
        vertices=vertices,
        faces=faces,
        uv=None,
        texture_linear=None,
        vertex_color_linear=np.clip(0.3 * color, 0, 1),
    )


def test_shut_eyes_are_not_put_on_black_brows(shared_data, model):
    landmarks = np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    scan = with_shut_eyes(load_scan(shared_data / "james.obj"), landmarks)
    fitted = fit(scan, model, register(scan, model))
    places = transform_points(invert_rigid(fitted.model_from_scan), fitted.landmarks)
    assert row_lengths(places - landmarks)[36:48].max() < 5.0
