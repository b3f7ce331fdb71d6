"""Several meshes in one GLB, each of one colour; a face that moves."""

import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from scan2albedo.io.glb import GlbPart, write_glb, write_parts_glb


def test_parts_come_back_with_their_colours(tmp_path):
    ball = trimesh.creation.icosphere(1, 20.0)
    stray = np.vstack([ball.vertices, [[999.0, 0, 0]]])
    glass = GlbPart("glass", np.eye(3), [[0, 1, 2]], (0.1, 0.5, 2.0), opacity=0.25, roughness=0.05)
    write_parts_glb(tmp_path / "a.glb", [GlbPart("ball", stray, ball.faces, (0.2, 0.4, 0.6)), glass])
    scene = trimesh.load_scene(tmp_path / "a.glb")
    found = scene.geometry["ball"]
    assert found.is_watertight
    np.testing.assert_allclose(1000 * found.bounds, ball.bounds, atol=1e-4)
    assert found.visual.material.alphaMode is None
    seen = scene.geometry["glass"].visual.material
    assert seen.alphaMode == "BLEND"
    np.testing.assert_allclose(np.array(seen.baseColorFactor) / 255, [0.1, 0.5, 1, 0.25], atol=0.005)


def test_what_is_no_mesh_is_refused(tmp_path):
    with pytest.raises(ValueError, match="needs a mesh"):
        write_parts_glb(tmp_path / "a.glb", [])
    for vertices, faces in ((np.eye(3), np.zeros((0, 3), int)), (np.eye(3) * np.nan, [[0, 1, 2]])):
        with pytest.raises(ValueError, match="'part' needs faces"):
            write_parts_glb(tmp_path / "a.glb", [GlbPart("part", vertices, faces, (1, 1, 1))])
    assert list(tmp_path.iterdir()) == []


def moving(file):
    """Return vertices (V, 3), targets (K, V, 3) and curves of a face that moves, as the standard says."""
    data = file.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    tree, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def array(number):
        accessor = tree["accessors"][number]
        start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(-1, width)
        if "min" in accessor:
            np.testing.assert_array_equal(accessor["max"], values.max(0))
        return values

    (animation,), (mesh,) = tree["animations"], tree["meshes"]
    samplers = animation["samplers"]
    curves = {c["target"]["path"]: array(samplers[c["sampler"]]["output"]) for c in animation["channels"]}
    curves["time_s"] = array(samplers[0]["input"])[:, 0]
    np.testing.assert_allclose(mesh["weights"], curves["weights"].reshape(len(curves["time_s"]), -1)[0])
    (primitive,) = mesh["primitives"]
    targets = np.stack([array(target["POSITION"]) for target in primitive["targets"]])
    return array(primitive["attributes"]["POSITION"]), targets, curves


def test_a_moving_face_has_targets_whose_weights_and_pose_are_animated(tmp_path):
    rng, ball = np.random.default_rng(0), trimesh.creation.icosphere(1, 20.0)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces, np.int64)
    targets, weights = rng.normal(size=(2, len(vertices), 3)), rng.normal(size=(4, 2))
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1:, :3, :3] = Rotation.random(3, random_state=1).as_matrix()
    poses[1:, :3, 3] = rng.normal(size=(3, 3)) * 30
    file = tmp_path / "a.glb"
    take = {"time_s": np.arange(4) / 25, "targets": targets, "weights": weights, "pose": poses}
    write_glb(file, vertices, faces, take=take)
    assert trimesh.load_scene(file).geometry["face"].faces.shape == faces.shape
    base, moved, curves = moving(file)
    np.testing.assert_allclose(curves["time_s"], np.arange(4) / 25, rtol=1e-6)
    for t in range(4):
        bent = base + np.tensordot(curves["weights"].reshape(4, 2)[t], moved, 1)
        placed = Rotation.from_quat(curves["rotation"][t]).apply(bent) + curves["translation"][t]
        true = (vertices + np.tensordot(weights[t], targets, 1)) @ poses[t, :3, :3].T + poses[t, :3, 3]
        np.testing.assert_allclose(1000 * placed, true, atol=1e-3)
