"""Named extremes: whatever the scan, a pose, or one clear refusal; never NaN, never a crash."""

from importlib import import_module

import numpy as np
import pytest
from helpers.poses import assert_near, moved

from scan2albedo import RawScan, register
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.rigid import compose, random_rotation


@pytest.fixture(scope="module")
def plain(synthetic_scan, model):
    example = synthetic_scan(11)
    return example, register(example.scan, model)


@pytest.mark.parametrize("reach_mm", [500.0, 1e6])
def test_any_pose_gives_the_pose_of_the_scan_unposed(plain, model, reach_mm):
    example, straight = plain
    rng = np.random.default_rng(3)
    pose = compose(random_rotation(rng), rng.uniform(-reach_mm, reach_mm, 3))
    turned = register(moved(example.scan, pose), model)
    # 1e6 mm away a coordinate keeps 1e-10 mm; the matrix product with that offset keeps less.
    assert_near(turned.model_from_scan @ pose, straight.model_from_scan, 1e-3, 1e-3)


@pytest.mark.parametrize(("unit", "factor"), [("micrometres", 1e3), ("metres", 1e-3), ("kilometres", 1e-6)])
def test_a_scan_taken_for_millimetres_is_refused_at_once_with_box_and_unit(
    plain, model, monkeypatch, unit, factor
):
    def searched(*_):
        raise AssertionError("the size must be looked at before the search")

    monkeypatch.setattr(import_module("scan2albedo.registration.register"), "coarse_poses", searched)
    scan = plain[0].scan
    mends = f"{1 / factor:g}".replace("+", r"\+")
    with pytest.raises(RegistrationError, match=rf"{unit}: .*box .* mm.*unit.*multiplied by {mends} "):
        register(RawScan(scan.vertices * factor, scan.faces, name=unit), model)


def test_a_far_crumb_does_not_make_a_scan_too_large(plain, model):
    example, straight = plain
    crumb = np.array([[9e3, 0, 0], [9e3, 5, 0], [9e3, 0, 5]]), np.array([[0, 1, 2]])
    scan = RawScan(*join([(example.scan.vertices, example.scan.faces), crumb]))
    assert_near(register(scan, model).model_from_scan, straight.model_from_scan, 2, 2)
