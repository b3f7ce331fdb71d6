"""Named extremes: whatever the scan, a pose, or one clear refusal; never NaN, never a crash."""

from importlib import import_module

import numpy as np
import pytest

from scan2albedo import RawScan, register
from scan2albedo.errors import RegistrationError, ScanError
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


@pytest.mark.parametrize("unit_mm", [1e-3, 1e6])
def test_micrometres_and_kilometres_are_refused_when_loaded(plain, unit_mm):
    vertices, faces = plain[0].scan.vertices / unit_mm, plain[0].scan.faces
    with pytest.raises(ScanError, match="no head in mm, cm or m"):
        millimetres_per_unit(vertices, vertex_components(len(vertices), faces), "auto", "scan")


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


def test_one_triangle_is_refused(model):
    triangle = RawScan([[0.0, 0, 0], [90, 0, 0], [0, 120, 0]], [[0, 1, 2]], name="triangle")
    with pytest.raises(RegistrationError, match="triangle: 3 vertices"):
        register(triangle, model)


def test_slivers_and_coincident_vertices_change_nothing(plain, model):
    example, straight = plain
    vertices, faces = example.scan.vertices, example.scan.faces
    rng = np.random.default_rng(0)
    picked = faces[rng.choice(len(faces), 2000, replace=False)]
    first = len(vertices)
    doubled = np.concatenate([vertices, vertices[picked[:, 0]], vertices[picked[:, 1]] + 1e-9])
    slivers = np.stack([picked[:, 0], np.arange(2000) + first, np.arange(2000) + first + 2000], 1)
    found = register(RawScan(doubled, np.concatenate([faces, slivers])), model)
    degrees, millimetres = difference(found.model_from_scan, straight.model_from_scan)
    assert degrees < 0.1
    assert millimetres < 0.1


def test_a_budget_of_a_twentieth_of_a_second(plain, model):
    found = register(plain[0].scan, model, 0.05)
    assert not found.converged
    assert np.isfinite(found.model_from_scan).all()
    np.testing.assert_allclose(
        found.model_from_scan[:3, :3] @ found.model_from_scan[:3, :3].T, np.eye(3), atol=1e-12
    )


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


def test_the_settled_pose_does_not_depend_on_the_seed(plain, model):
    example, straight = plain
    degrees, millimetres = difference(
        register(example.scan, model, seed=5).model_from_scan, straight.model_from_scan
    )
    assert degrees < 0.5
    assert millimetres < 0.5
