"""What is not a face is refused with the figures; what is one in hard conditions is not."""

import numpy as np
import pytest
import trimesh

from scan2albedo import RawScan, register
from scan2albedo.errors import NoFaceError, RegistrationError
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_angle_rad


def scan_of(mesh: trimesh.Trimesh, name: str) -> RawScan:
    return RawScan(np.asarray(mesh.vertices), np.asarray(mesh.faces), name=name)


def sphere():
    return scan_of(trimesh.creation.icosphere(5, 90.0), "sphere")


def cube():
    box = trimesh.creation.box((180, 180, 180))
    for _ in range(4):
        box = box.subdivide()
    return scan_of(box, "cube")


def blob(seed):
    mesh = trimesh.creation.icosphere(5, 1.0)
    unit, rng = np.asarray(mesh.vertices), np.random.default_rng(seed)
    axes = rng.normal(size=(20, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    height = np.exp((unit @ axes.T - 1) * rng.uniform(3, 50, 20)) @ rng.normal(scale=0.1, size=20)
    return RawScan(unit * (90 * (1 + height))[:, None], np.asarray(mesh.faces), name="blob")


@pytest.mark.slow
@pytest.mark.parametrize("scan", [sphere(), cube(), blob(0), blob(1)], ids=lambda scan: scan.name)
def test_bodies_without_a_face_are_refused(scan, model):
    with pytest.raises(NoFaceError, match=r"no face found.*probability of 0\.\d+.*over \d+ %") as caught:
        register(scan, model)
    assert scan.name in str(caught.value)
    assert caught.value.confidence < 0.25
    pose = caught.value.model_from_scan
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)


def test_eyeglasses_are_refused(shared_data, model):
    mesh = trimesh.load(shared_data / "sunglasses_khronos.glb", force="mesh")
    scan = RawScan(np.asarray(mesh.vertices) * 1000, np.asarray(mesh.faces), name="sunglasses")
    with pytest.raises(RegistrationError, match="sunglasses"):
        register(scan, model)


def test_the_back_of_a_head_is_refused(ict, model):
    vertices, faces = ict["generic_neutral"], ict["faces"]
    behind = faces[(vertices[faces][..., 2] < 25).all(1)]
    with pytest.raises(RegistrationError, match="no face found"):
        register(RawScan(vertices, behind, name="back"), model)


@pytest.mark.parametrize("side", [-1, 1])
def test_half_a_face_is_enough(synthetic_scan, model, side):
    example = synthetic_scan(6, hair=False, shoulders=False)
    in_model = example.scan.vertices @ example.model_from_scan[:3, :3].T + example.model_from_scan[:3, 3]
    kept = (side * in_model[:, 0][example.scan.faces] > 0).all(1)
    registration = register(RawScan(example.scan.vertices, example.scan.faces[kept]), model)
    degrees, millimetres = example.error(registration.model_from_scan)
    assert degrees < 10
    assert millimetres < 15


@pytest.mark.slow
@pytest.mark.parametrize("side", [-1, 1])
def test_half_a_face_unlike_the_model_is_found(ict_scan, model, side):
    example = ict_scan("person4", 304, noise_mm=0.3)
    in_model = example.scan.vertices @ example.model_from_scan[:3, :3].T + example.model_from_scan[:3, 3]
    kept = (side * in_model[:, 0][example.scan.faces] > 0).all(1)
    half = register(RawScan(example.scan.vertices, example.scan.faces[kept]), model)
    assert half.confidence > 0.5
    degrees, millimetres = example.error(half.model_from_scan)
    assert degrees < 5
    assert millimetres < 10


def test_a_million_millimetres_from_the_origin_changes_nothing(synthetic_scan, posed, model):
    scan = synthetic_scan(7).scan
    far = compose(np.eye(3), [1e6, -1e6, 1e6])
    near, away = register(scan, model), register(posed(scan, far), model)
    change = away.model_from_scan @ far @ invert_rigid(near.model_from_scan)
    assert np.degrees(rotation_angle_rad(change[:3, :3])) < 0.1
    assert np.linalg.norm(change[:3, 3]) < 0.1


def test_shoulders_three_times_as_wide_as_the_face(synthetic_scan, model):
    example = synthetic_scan(8)
    x, y = np.meshgrid(np.linspace(-225, 225, 91), np.linspace(-300, -110, 39))
    sheet = np.stack([x, y, 40 - (x / 60) ** 2 * 6 - (y + 200) ** 2 / 150 + 3 * np.sin(x / 9)], -1).reshape(
        -1, 3
    )
    index = np.arange(39 * 91).reshape(39, 91)
    corners = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    a, b, c, d = (corner.ravel() for corner in corners)
    sheet_faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    scan_from_model = invert_rigid(example.model_from_scan)
    clothes = sheet @ scan_from_model[:3, :3].T + scan_from_model[:3, 3]
    offset = len(example.scan.vertices)
    scan = RawScan(
        np.concatenate([example.scan.vertices, clothes]),
        np.concatenate([example.scan.faces, sheet_faces + offset]),
    )
    degrees, millimetres = example.error(register(scan, model).model_from_scan)
    assert degrees < 10
    assert millimetres < 15


def test_a_tenth_larger_or_smaller_face_is_still_found(synthetic_scan, model):
    example = synthetic_scan(9)
    center = example.scan.vertices.mean(0)
    for factor in (0.9, 1.1):
        scan = RawScan(center + factor * (example.scan.vertices - center), example.scan.faces)
        registration = register(scan, model)
        assert example.error(registration.model_from_scan)[0] < 6
        assert registration.confidence > 0.5
