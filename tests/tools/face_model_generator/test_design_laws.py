"""The published measures, found again in the design that follows from them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from face_model_generator.anthropometry import Measurements
from face_model_generator.features import Ellipsoid, Eye, Nose, arch_drop, smooth_max
from face_model_generator.key_points import half_face
from face_model_generator.profile import Plumb, gonion, midline, tragion
from face_model_generator.sections import CHEEK_HEIGHT_MM, WING_HEIGHT_MM, Offset, Sections

TABLE = Measurements()


@pytest.fixture(scope="module")
def middle():
    return {name: np.array(point) for name, point in midline(TABLE).items()}


@pytest.fixture(scope="module")
def ear(middle):
    return tragion(TABLE, middle)


@pytest.fixture(scope="module")
def skin(middle):
    return Sections.of(TABLE, {name: tuple(point) for name, point in middle.items()})


def distance(a, b) -> float:
    return float(np.linalg.norm(np.asarray(a) - np.asarray(b)))


def angle_deg(a, at, b) -> float:
    one, other = a - at, b - at
    return float(np.degrees(np.arccos(one @ other / np.linalg.norm(one) / np.linalg.norm(other))))


def test_profile_descends(middle):
    assert all(upper[1] > lower[1] for upper, lower in pairwise(middle.values()))
    assert all(point[0] == 0 for point in middle.values())


@pytest.mark.parametrize(
    ("measurement", "first", "second"),
    [("face_height_mm", "n", "gn"), ("nose_height_mm", "n", "sn"), ("upper_face_height_mm", "n", "sto"),
     ("nose_protrusion_mm", "sn", "prn")],
)  # fmt: skip
def test_distances_of_the_profile(middle, measurement, first, second):
    expected = getattr(TABLE, measurement)
    assert distance(middle[first], middle[second]) == pytest.approx(expected, abs=1.0)


def test_angles_of_the_profile(middle):
    assert angle_deg(middle["glabella"], middle["n"], middle["prn"]) == pytest.approx(
        TABLE.nasofrontal_angle_deg, abs=4
    )
    nasolabial = angle_deg(middle["columella"], middle["sn"], middle["ls"])
    assert nasolabial == pytest.approx(TABLE.nasolabial_angle_deg, abs=3)
    n_pg = middle["pg"] - middle["n"]
    assert np.degrees(np.arctan2(n_pg[2], -n_pg[1])) + 90 == pytest.approx(TABLE.facial_angle_deg, abs=0.5)
    convexity = 180 - angle_deg(middle["glabella"], middle["sn"], middle["pg"])
    assert 8 <= convexity <= 16  # Legan and Burstone: 12 +- 4


def test_depths_before_the_true_vertical_line(middle):
    plumb = Plumb.of(TABLE)
    for name, published in (("glabella", TABLE.glabella_mm), ("prn", TABLE.tip_mm), ("sn", 0.0),
                            ("upper_lip", TABLE.upper_lip_mm), ("pg", TABLE.chin_mm)):  # fmt: skip
        upright = middle[name][2] - plumb.lean * middle[name][1] - plumb.subnasale_z_mm
        assert upright == pytest.approx(published, abs=1e-9)


def test_ear_and_jaw_are_where_their_distances_say(middle, ear):
    assert distance(ear, middle["n"]) == pytest.approx(TABLE.upper_face_depth_mm, abs=1e-6)
    assert distance(ear, middle["sn"]) == pytest.approx(TABLE.middle_face_depth_mm, abs=2)
    assert distance(ear, middle["gn"]) == pytest.approx(TABLE.lower_face_depth_mm, abs=2)
    jaw = gonion(TABLE, ear, middle["gn"])
    assert distance(jaw, ear) == pytest.approx(TABLE.jaw_height_mm, abs=8)
    assert distance(jaw, middle["gn"]) == pytest.approx(TABLE.jaw_length_mm, abs=1e-6)


def test_sections_run_from_the_profile_to_the_ear(skin, middle, ear):
    for name in ("tr", "forehead", "glabella", "sl", "pg", "gn"):
        _, y, z = middle[name]
        assert float(skin.depth(0.0, y)) == pytest.approx(z, abs=1.5)
    assert float(skin.width(ear[1], ear[2] + 1e-6)) == pytest.approx(ear[0], abs=1e-3)
    heights = np.linspace(-120, 60, 50)
    for x in (10.0, 25.0):
        assert np.all(skin.drop(np.full(50, x), heights) > skin.drop(np.full(50, x / 2), heights))


def test_width_inverts_drop(skin):
    y = np.array([40.0, 10.0, -30.0, -60.0, -95.0, -110.0])
    x = np.array([30.0, 50.0, 60.0, 45.0, 40.0, 20.0])
    z = skin.front(y) - skin.drop(x, y)
    np.testing.assert_allclose(skin.width(y, z), x, atol=1e-9)


def test_published_cheek_and_wing(skin):
    plumb = Plumb.of(TABLE)
    beside = float(skin.depth(TABLE.nose_width_mm / 2 + 0.5, WING_HEIGHT_MM))
    assert beside == pytest.approx(plumb.depth(TABLE.wing_base_mm, WING_HEIGHT_MM), abs=0.5)
    cheek = float(skin.depth(TABLE.pupil_distance_mm / 2, CHEEK_HEIGHT_MM))
    assert cheek == pytest.approx(plumb.depth(TABLE.under_pupil_mm, CHEEK_HEIGHT_MM), abs=1.5)


def test_eye(skin, ear):
    eye = Eye.of(TABLE, ear, skin)
    assert distance(eye.outer, ear) == pytest.approx(TABLE.eye_corner_to_ear_mm, abs=1e-9)
    pole = float(eye.ball.front(*eye.ball.center[:2]))
    assert pole + TABLE.cornea_mm == pytest.approx(-TABLE.nasion_before_cornea_mm)
    x, y = np.array([28.0, 31.0, 34.0]), np.full(3, -3.0)
    assert np.all(eye.cover(x, y, 1.0) > eye.ball.front(x, y))


def test_nose_is_widest_at_its_wings_and_highest_at_its_tip(skin, middle):
    nose = Nose.of(TABLE, {name: tuple(point) for name, point in middle.items()}, skin)
    assert nose.wing.center[0] + nose.wing.axes[0] == pytest.approx(TABLE.nose_width_mm / 2)
    y = np.linspace(-44, -5, 40)
    depths = np.stack([nose.depth(np.full(40, x), y) for x in (0.5, 5.0, 10.0)])
    assert np.all(np.diff(depths, axis=0) < 0)
    assert nose.depth(0.0, middle["prn"][1]) == pytest.approx(middle["prn"][2], abs=1.5)


def test_lips_follow_the_dental_arch():
    across = TABLE.arch_width_mm / 2 + TABLE.lip_thickness_mm
    assert float(arch_drop(TABLE, 0.0)) == 0
    assert float(arch_drop(TABLE, across)) == pytest.approx(TABLE.arch_depth_mm + TABLE.lip_thickness_mm)


def test_small_shapes():
    assert float(smooth_max(5.0, -50.0, 1.0)) == pytest.approx(5.0, abs=0.01)
    ball = Ellipsoid((1.0, 2.0, 3.0), (4.0, 4.0, 4.0))
    assert float(ball.front(1.0, 2.0)) == 7.0
    assert float(ball.front(6.0, 2.0)) < 3.0
    rise = Offset((20.0, 0.0), (3.0, 5.0), 2.0)
    x = np.array([20.0, -20.0, 0.0])
    np.testing.assert_allclose(rise(x, np.zeros(3)), [2, 2, 0], atol=1e-6)


def test_a_bigger_nose_and_a_longer_face_change_the_design():
    other = half_face(Measurements(face_height_mm=124.0, tip_mm=18.0, nose_protrusion_mm=21.0))
    base = half_face(TABLE)
    assert other.middle["prn"][2] > base.middle["prn"][2] + 1
    assert other.middle["gn"][1] == pytest.approx(base.middle["gn"][1] - 6, abs=0.3)
