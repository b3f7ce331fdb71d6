"""Named extremes: whatever the scan, a pose, or one clear refusal; never NaN, never a crash."""

from importlib import import_module

import numpy as np
import pytest
from helpers.poses import assert_near, moved

from scan2albedo import RawScan, register
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import join, vertex_components
from scan2albedo.geometry.rigid import compose, random_rotation
from scan2albedo.io.units import millimetres_per_unit


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


@pytest.mark.parametrize("unit_mm", [1.0, 10.0, 1000.0])
def test_millimetres_centimetres_and_metres(plain, model, unit_mm):
    example, straight = plain
    stored = example.scan.vertices / unit_mm
    components = vertex_components(len(stored), example.scan.faces)
    factor, _ = millimetres_per_unit(stored, components, "auto", "scan")
    found = register(RawScan(stored * factor, example.scan.faces), model)
    assert_near(found.model_from_scan, straight.model_from_scan, 1e-3, 1e-3)


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


# Seen from behind, where its triangles face outward again, each synthetic person looks somewhat like a face.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "which"), [("ict_scan", ("person1", 4)), *(("synthetic_scan", (seed,)) for seed in (2, 9, 11))]
)
def test_an_inside_out_scan_is_refused_with_that_reason(request, model, kind, which):
    scan = request.getfixturevalue(kind)(*which).scan
    with pytest.raises(RegistrationError, match=r"inside out.*Reverse the order"):
        register(scan.inside_out(), model)


def test_floaters_and_spikes(synthetic_scan, model):
    example = synthetic_scan(12, spikes=300, crumbs=40)
    example.assert_found(register(example.scan, model).model_from_scan, 6, 8)


def test_two_thousand_vertices(synthetic_scan, model):
    example = synthetic_scan(13, spacing_mm=6.5, hair=False, shoulders=False)
    assert len(example.scan.vertices) < 2500
    example.assert_found(register(example.scan, model).model_from_scan, 6, 8)
