"""Named extremes: whatever the scan, a pose, or one clear refusal; never NaN, never a crash."""

from importlib import import_module

import numpy as np
import pytest

from scan2albedo import RawScan, register
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rigid import compose, invert_rigid, random_rotation, rotation_angle_rad
from scan2albedo.io.units import millimetres_per_unit


def difference(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    change = a @ invert_rigid(b)
    return float(np.degrees(rotation_angle_rad(change[:3, :3]))), float(np.linalg.norm(change[:3, 3]))


@pytest.fixture(scope="module")
def plain(synthetic_scan, model):
    example = synthetic_scan(11)
    return example, register(example.scan, model)


@pytest.mark.parametrize("reach_mm", [500.0, 1e6])
def test_any_pose_gives_the_pose_of_the_scan_unposed(plain, posed, model, reach_mm):
    example, straight = plain
    rng = np.random.default_rng(3)
    pose = compose(random_rotation(rng), rng.uniform(-reach_mm, reach_mm, 3))
    turned = register(posed(example.scan, pose), model)
    # 1e6 mm away a coordinate keeps 1e-10 mm; the matrix product with that offset keeps less.
    degrees, millimetres = difference(turned.model_from_scan @ pose, straight.model_from_scan)
    assert degrees < 1e-3
    assert millimetres < 1e-3


@pytest.mark.parametrize("unit_mm", [1.0, 10.0, 1000.0])
def test_millimetres_centimetres_and_metres(plain, model, unit_mm):
    example, straight = plain
    stored = example.scan.vertices / unit_mm
    components = vertex_components(len(stored), example.scan.faces)
    factor, _ = millimetres_per_unit(stored, components, "auto", "scan")
    found = register(RawScan(stored * factor, example.scan.faces), model)
    degrees, millimetres = difference(found.model_from_scan, straight.model_from_scan)
    assert degrees < 1e-3
    assert millimetres < 1e-3


@pytest.mark.parametrize(("unit", "factor"), [("micrometres", 1e3), ("metres", 1e-3), ("kilometres", 1e-6)])
def test_a_scan_taken_for_millimetres_is_refused_at_once_with_box_and_unit(
    plain, model, monkeypatch, unit, factor
):
    def searched(*_: object) -> None:
        raise AssertionError("the size must be looked at before the search")

    monkeypatch.setattr(import_module("scan2albedo.registration.register"), "coarse_poses", searched)
    scan = plain[0].scan
    mends = f"{1 / factor:g}".replace("+", r"\+")
    with pytest.raises(RegistrationError, match=rf"{unit}: .*box .* mm.*unit.*multiplied by {mends} "):
        register(RawScan(scan.vertices * factor, scan.faces, name=unit), model)


def test_a_far_crumb_does_not_make_a_scan_too_large(plain, model):
    example, straight = plain
    first = len(example.scan.vertices)
    crumb = np.array([[9e3, 0, 0], [9e3, 5, 0], [9e3, 0, 5]])
    scan = RawScan(
        np.concatenate([example.scan.vertices, crumb]),
        np.concatenate([example.scan.faces, [[first, first + 1, first + 2]]]),
    )
    degrees, millimetres = difference(register(scan, model).model_from_scan, straight.model_from_scan)
    assert degrees < 2
    assert millimetres < 2


@pytest.mark.slow
def test_an_inside_out_scan_is_refused_with_that_reason(ict_scan, model):
    scan = ict_scan("person1", 4).scan
    with pytest.raises(RegistrationError, match=r"inside out.*Reverse the order"):
        register(RawScan(scan.vertices, scan.faces[:, ::-1], name="turned"), model)


# Seen from behind, where its triangles face outward again, each of these looks somewhat like a face.
@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 9, 11])
def test_a_synthetic_person_inside_out_is_refused_with_that_reason(synthetic_scan, model, seed):
    scan = synthetic_scan(seed).scan
    with pytest.raises(RegistrationError, match=r"inside out.*Reverse the order"):
        register(RawScan(scan.vertices, scan.faces[:, ::-1], name="turned"), model)


def test_floaters_and_spikes(synthetic_scan, model):
    example = synthetic_scan(12, spikes=300, crumbs=40)
    degrees, millimetres = example.error(register(example.scan, model).model_from_scan)
    assert degrees < 6
    assert millimetres < 8


def test_two_thousand_vertices(synthetic_scan, model):
    example = synthetic_scan(13, spacing_mm=6.5, hair=False, shoulders=False)
    assert len(example.scan.vertices) < 2500
    degrees, millimetres = example.error(register(example.scan, model).model_from_scan)
    assert degrees < 6
    assert millimetres < 8
