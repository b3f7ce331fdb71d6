"""Rims of synthetic frames against their known inner outlines; lenses that fill them."""

import numpy as np
import pytest
from helpers.eyeglasses import glazed, outline_distances
from helpers.lens_frames import from_lens, half_rimless

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.inserted_lenses import lens_mesh
from scan2albedo.eyeglasses.lenses.rims import find_lens_rim, fit_normal
from scan2albedo.geometry.mesh import face_areas, face_normals, join
from scan2albedo.geometry.rigid import compose, random_rotation, transform_points
from scan2albedo.synthetic import GlassesBend, eyeglasses

BENT = GlassesBend(8, 2, 4)
BAR_MM = 0.2


def rim_points(glasses, side):
    return glasses.keypoints[[i for i, n in enumerate(glasses.names) if n.startswith(f"{side}_rim")]]


def find(glasses, side=0, **changes):
    given = {"vertices": glasses.vertices, "faces": glasses.faces, "center": glasses.lens_centers[side]}
    marks = rim_points(glasses, ("left", "right")[side])
    return find_lens_rim(**{**given, "rim_points": marks, **changes})


def off(rim, glasses, side=0):
    """Distances of a rim's points from the true outline."""
    return outline_distances(rim.points, glasses.lens_outlines[side])


@pytest.mark.parametrize("welded", [True, False])
@pytest.mark.parametrize("bend", [GlassesBend(), BENT])
def test_the_rim_is_the_true_inner_outline(welded, bend):
    for seed in range(8):
        glasses = eyeglasses(seed, welded=welded, bend=bend)
        for side in range(2):
            rim = find(glasses, side)
            assert off(rim, glasses, side).max() <= BAR_MM
            assert outline_distances(glasses.lens_outlines[side], rim.points).max() <= BAR_MM
            assert rim.normal[2] > 0.9
            assert rim.measured.mean() > 0.85


def test_a_given_normal_will_do_and_need_not_be_exact():
    glasses = eyeglasses(2)
    exact = fit_normal(rim_points(glasses, "left"), glasses.vertices)
    for error in ([0, 0, 0], [0.08, 0, 0], [-0.05, 0.06, 0], [0, -0.08, 0]):
        rim = find(glasses, rim_points=None, normal=3 * (exact + error))
        assert off(rim, glasses).max() <= BAR_MM


def test_pose_and_unit_do_not_matter():
    rng = np.random.default_rng(0)
    glasses = eyeglasses(3, welded=False)
    given = glasses.vertices, glasses.lens_centers[1], rim_points(glasses, "right"), glasses.lens_outlines[1]
    for scale in (1.0, 1e-3, 1e3):
        pose = compose(scale * random_rotation(rng), scale * rng.normal(0, 1000, 3))
        vertices, center, marks, outline = (transform_points(pose, points) for points in given)
        rim = find(glasses, vertices=vertices, center=center, rim_points=marks)
        assert outline_distances(rim.points, outline).max() <= scale * BAR_MM
        assert rim.normal @ pose[:3, 2] > 0.9 * scale


def test_winding_repeated_faces_and_floaters_do_not_matter():
    glasses = eyeglasses(4)
    own = glasses.faces
    faces = np.concatenate([own[::2, ::-1], own[1::2], own[:50], [[0, 0, 1]]])
    crumb = glasses.lens_centers[0] + [15, 2, 0] + np.eye(3) / 3
    vertices, faces = join([(glasses.vertices, faces), (crumb, np.array([[0, 1, 2]]))])
    assert off(find(glasses, vertices=vertices, faces=faces), glasses).max() <= BAR_MM


def test_small_gaps_are_interpolated_without_key_points():
    glasses = eyeglasses(5)
    x, y, _ = from_lens(glasses).T
    angle = np.rad2deg(np.arctan2(y, x))
    hole = (np.hypot(x, y) < 40) & ((np.abs(angle - 80) < 7) | (np.abs(angle + 60) < 5))
    rim = find(glasses, faces=glasses.faces[~hole], rim_points=None, normal=[0.1, 0, 1])
    assert rim.gaps == "interpolated"
    assert 0.7 < rim.measured.mean() < 0.97
    assert off(rim, glasses)[rim.measured].max() <= BAR_MM
    assert off(rim, glasses).max() <= 1.0


@pytest.mark.parametrize("bend", [GlassesBend(), BENT])
def test_an_open_side_is_rounded_off_from_the_key_points(bend):
    for seed in range(4):
        glasses = eyeglasses(seed, bend=bend, nose_pads=False)
        half_rim = half_rimless(glasses)
        rim = find(glasses, faces=half_rim)
        assert rim.gaps == "subdivided"
        assert 0.4 < rim.measured.mean() < 0.75
        assert off(rim, glasses)[rim.measured].max() <= BAR_MM
        assert off(rim, glasses).max() <= 5.0
        lens_mesh(rim.center, rim.points)
        with pytest.raises(EyeglassesError, match="no closed rim"):
            find(glasses, faces=half_rim, rim_points=None, normal=rim.normal)


def test_without_any_rim_the_outline_runs_through_the_key_points():
    glasses = eyeglasses(6)
    beside = np.abs(from_lens(glasses))[:, :2].max(1) >= 40
    rim = find(glasses, faces=glasses.faces[beside])
    assert rim.gaps == "subdivided"
    assert not rim.measured.any()
    assert off(rim, glasses).max() <= 5.0


def test_a_lens_fills_its_rim_and_faces_the_viewer():
    glasses = eyeglasses(8, bend=BENT)
    rim = find(glasses)
    outline = glasses.lens_outlines[0] - rim.center
    area = np.linalg.norm(np.cross(outline, np.roll(outline, -1, 0)), axis=1).sum() / 2
    for points, normal in ((rim.points, None), (rim.points, rim.normal), (rim.points[::-1], rim.normal)):
        vertices, faces = lens_mesh(rim.center, points, normal)
        assert (vertices.shape, faces.shape) == ((129, 3), (128, 3))
        assert (face_normals(vertices, faces) @ rim.normal > 0.8).all()
        assert face_areas(vertices, faces).sum() == pytest.approx(area, rel=0.01)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rim_points": None}, "needs rim_points"),
        ({"rim_points": [[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]}, "one line"),
        ({"normal": [0.0, 0, 0]}, "not zero"),
        ({"faces": np.zeros((0, 3), int)}, "no faces"),
    ],
)
def test_what_cannot_be_done_is_said(changes, words):
    with pytest.raises(EyeglassesError, match=words):
        find(eyeglasses(0), **changes)


def test_a_fan_that_folds_is_refused():
    with pytest.raises(EyeglassesError, match="fold"):
        lens_mesh([5.0, 0, 0], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])


@pytest.mark.parametrize("known", ["rim points", "normal"])
def test_lenses_that_the_mesh_holds_are_looked_through(known):
    glasses = eyeglasses(1)
    vertices, whole = glazed(glasses, gap=0.0)
    normal = fit_normal(rim_points(glasses, "left"), vertices)
    options = {} if known == "rim points" else {"rim_points": None, "normal": normal}
    rim = find(glasses, vertices=vertices, faces=whole, **options)
    np.testing.assert_allclose(rim.points, find(glasses, **options).points, atol=1e-4)
