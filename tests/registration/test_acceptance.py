"""What is not a face is refused with the figures; what is one in hard conditions is not."""

import numpy as np
import pytest
import trimesh
from helpers.meshes import grid, sphere

from scan2albedo import RawScan, register
from scan2albedo.errors import NoFaceError, RegistrationError
from scan2albedo.geometry.mesh import join, normalized
from scan2albedo.geometry.rigid import invert_rigid, transform_points


def blob(seed):
    (unit, faces), rng = sphere(5, 1.0), np.random.default_rng(seed)
    axes = normalized(rng.normal(size=(20, 3)))
    height = np.exp((unit @ axes.T - 1) * rng.uniform(3, 50, 20)) @ rng.normal(scale=0.1, size=20)
    return RawScan(unit * (90 * (1 + height))[:, None], faces, name="blob")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_bodies_without_a_face_are_refused(seed, model):
    scan = blob(seed)
    with pytest.raises(NoFaceError, match=r"no face found.*probability of 0\.\d+.*over \d+ %") as caught:
        register(scan, model)
    assert scan.name in str(caught.value)
    assert caught.value.confidence < 0.25
    pose = caught.value.model_from_scan
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)


def test_eyeglasses_are_refused(shared_data, model):
    mesh = trimesh.load(shared_data / "sunglasses_khronos.glb", force="mesh")
    scan = RawScan(1000 * mesh.vertices, mesh.faces, name="sunglasses")
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
    in_model = transform_points(example.model_from_scan, example.scan.vertices)
    kept = (side * in_model[:, 0][example.scan.faces] > 0).all(1)
    half = RawScan(example.scan.vertices, example.scan.faces[kept])
    example.assert_found(register(half, model), 10, 15)


def test_shoulders_three_times_as_wide_as_the_face(synthetic_scan, model):
    example = synthetic_scan(8)
    sheet, faces = grid(91, 39)
    x, y, _ = (sheet * [450, 190, 0] - [225, 300, 0]).T
    height = 40 - (x / 60) ** 2 * 6 - (y + 200) ** 2 / 150 + 3 * np.sin(x / 9)
    clothes = transform_points(invert_rigid(example.model_from_scan), np.column_stack([x, y, height]))
    scan = RawScan(*join([(example.scan.vertices, example.scan.faces), (clothes, faces)]))
    example.assert_found(register(scan, model), 10, 15)
