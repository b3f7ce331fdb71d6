"""Brows, eyes and lips in the scan's colours are found, and nothing where there is none."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from scan2albedo import fit, load_scan, register
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.painted_features import painted_features, painted_pull
from scan2albedo.geometry.mesh import vertex_normals
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
    right, left = (truth.landmarks[first : first + 6, 1].mean() for first in (36, 42))
    assert abs(places[36] - right) < 1.5
    assert abs(places[42] - left) < 1.5


def test_grey_pictures_show_them_too(fine_scan):
    grey = np.repeat(fine_scan[0].texture_linear.mean(-1, keepdims=True), 3, axis=-1)
    assert "brow" in {side.name for side, *_ in found_at(fine_scan, (0, 2, 0), texture_linear=grey)}


@pytest.mark.parametrize(
    "paint",
    [
        lambda shape: np.full(shape, 0.3),
        np.zeros,
        lambda shape: np.random.default_rng(0).uniform(0.2, 0.4, shape),
        lambda shape: np.linspace(0.1, 0.6, shape[1])[:, None] * np.ones(shape),
    ],
    ids=["even", "black", "noise", "sideways light"],
)
def test_without_features_nothing_is_said(fine_scan, paint):
    texture = paint(fine_scan[0].texture_linear.shape).astype(np.float32)
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
    assert all(more >= less for more, less in pairwise(sure))
    assert sure[-1] == 0


def test_a_few_hot_texels_change_little(fine_scan):
    hot = fine_scan[0].texture_linear.copy()
    hot[np.random.default_rng(0).uniform(size=hot.shape[:2]) < 1e-4] = 1e6
    before, after = found_at(fine_scan), found_at(fine_scan, texture_linear=hot)
    assert [side.name for side, *_ in before] == [side.name for side, *_ in after]
    for one, other in zip(before, after, strict=True):
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


def with_shut_eyes(james, landmarks, drop_mm, dark, half_mm):
    """Return a scan with lids of brown skin, and with black brows `drop_mm` below where they were."""
    vertices, faces, uv = james.vertices, james.faces, james.uv
    corners = np.zeros((len(vertices), 2))
    corners[faces] = uv
    parts = np.column_stack([vertices, corners])
    for _ in range(2):
        parts, faces = trimesh.remesh.subdivide(parts, faces)[:2]
    vertices, corners = parts[:, :3], parts[:, 3:]
    size = np.array(james.texture_linear.shape[1::-1])
    columns, rows = np.clip(corners * [1, -1] * size + [0, size[1]], 0, size - 1).astype(int).T
    color = james.texture_linear[rows, columns] * np.array([1.15, 0.85, 0.6])
    cheek = cKDTree(vertices).query((landmarks[1] + landmarks[31]) / 2, 400)[1]
    plain = np.median(color[cheek], axis=0)
    grain = np.random.default_rng(0).normal(1, 0.04, (len(vertices), 1))

    def away(points):
        steps = np.linspace(0, len(points) - 1, 200)
        line = np.stack([np.interp(steps, range(len(points)), points[:, k]) for k in range(3)], axis=1)
        return cKDTree(line).query(vertices)[0]

    for first_of_eye, first_of_brow in ((36, 17), (42, 22)):
        lids = landmarks[first_of_eye : first_of_eye + 6]
        brow = landmarks[first_of_brow : first_of_brow + 5]
        across = np.stack([lids[0], lids.mean(0), lids[3]])
        beside = np.minimum(away(np.concatenate([lids, lids[:1]])), away(across))
        for distance, half, soft, paint, strength in (
            (away(brow - [0, 2, 0]), 7.0, 3.0, plain, 1.0),
            (beside, 6.0, 3.0, plain, 1.0),
            (away(lids[[0, 5, 4, 3]]), 0.5, 0.7, 0.3 * plain, 0.8),
            (away(brow - [0, drop_mm, 0]), half_mm, 1.2, np.full(3, 0.06 * plain[0]), 0.95),
        ):
            cover = strength * np.clip(1 - (distance - half) / soft, 0, 1)[:, None]
            color = color * (1 - cover) + paint * grain * cover
    return replace(
        james,
        vertices=vertices,
        faces=faces,
        uv=None,
        texture_linear=None,
        vertex_color_linear=np.clip(dark * color, 0, 1),
    )


@pytest.mark.parametrize(
    "scene",
    [(6, 0.3, 5), *(pytest.param(more, marks=pytest.mark.slow) for more in ((10, 0.3, 5), (12, 0.2, 7)))],
    ids=str,
)
def test_shut_eyes_are_not_put_on_black_brows(shared_data, model, scene):
    landmarks = np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    james = load_scan(shared_data / "james.obj")
    scan = with_shut_eyes(james, landmarks, *scene)
    fitted = fit(scan, model, register(scan, model))
    places = transform_points(invert_rigid(fitted.model_from_scan), fitted.landmarks)
    assert np.linalg.norm(places - landmarks, axis=1)[36:48].max() < 5.0


@pytest.mark.slow
def test_a_green_statue_in_the_light_is_fitted_as_its_bare_shape(shared_data, model):
    scan = load_scan(shared_data / "james.obj")
    bare = replace(scan, uv=None, texture_linear=None)
    shading = 0.3 + 0.7 * np.clip(vertex_normals(scan.vertices, scan.faces) @ [0.3, 0.5, 0.81], 0, 1)
    grain = np.exp(0.02 * np.random.default_rng(0).standard_normal(len(shading)))
    green = np.outer(shading * grain, [0.1, 0.5, 0.15]).astype(np.float32)
    found = []
    for other in (bare, replace(bare, vertex_color_linear=green)):
        fitted = fit(other, model, register(other, model, seed=0))
        found.append(transform_points(invert_rigid(fitted.model_from_scan), fitted.landmarks))
    assert np.linalg.norm(found[0] - found[1], axis=1).max() < 0.3
