"""Several meshes in one GLB, each of one colour; a face that moves."""

import numpy as np
import pytest
import trimesh
from helpers.gltf import Gltf
from helpers.meshes import sphere
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from scan2albedo.geometry.rigid import compose, transform_points
from scan2albedo.io.glb import GlbPart, write_glb, write_parts_glb


def test_parts_come_back_with_their_colours(tmp_path):
    vertices, faces = sphere(1, 20.0)
    stray = np.vstack([vertices, [[999.0, 0, 0]]])
    glass = GlbPart("glass", np.eye(3), [[0, 1, 2]], (0.1, 0.5, 2.0), opacity=0.25, roughness=0.05)
    write_parts_glb(tmp_path / "a.glb", [GlbPart("ball", stray, faces, (0.2, 0.4, 0.6)), glass])
    scene = trimesh.load_scene(tmp_path / "a.glb")
    found = scene.geometry["ball"]
    assert found.is_watertight
    assert_allclose(1000 * found.bounds, [vertices.min(0), vertices.max(0)], atol=1e-4)
    assert found.visual.material.alphaMode is None
    seen = scene.geometry["glass"].visual.material
    assert seen.alphaMode == "BLEND"
    assert_allclose(np.array(seen.baseColorFactor) / 255, [0.1, 0.5, 1, 0.25], atol=0.005)


def test_what_is_no_mesh_is_refused(tmp_path):
    with pytest.raises(ValueError, match="needs a mesh"):
        write_parts_glb(tmp_path / "a.glb", [])
    for vertices, faces in ((np.eye(3), np.zeros((0, 3), int)), (np.eye(3) * np.nan, [[0, 1, 2]])):
        with pytest.raises(ValueError, match="'part' needs faces"):
            write_parts_glb(tmp_path / "a.glb", [GlbPart("part", vertices, faces, (1, 1, 1))])
    assert list(tmp_path.iterdir()) == []


def moving(path):
    """Return vertices (V, 3), targets (K, V, 3) and curves of a face that moves, as the standard says."""
    file = Gltf.read(path)
    (animation,), (mesh,) = file.tree["animations"], file.tree["meshes"]
    samplers = animation["samplers"]
    curves = {c["target"]["path"]: samplers[c["sampler"]]["output"] for c in animation["channels"]}
    curves = {name: file.array(number) for name, number in curves.items()}
    curves["time_s"] = file.array(samplers[0]["input"])[:, 0]
    assert_allclose(mesh["weights"], curves["weights"].reshape(len(curves["time_s"]), -1)[0])
    targets = np.stack([file.array(target["POSITION"]) for target in file.primitive["targets"]])
    return file.array(file.attributes["POSITION"]), targets, curves


def test_a_moving_face_has_targets_whose_weights_and_pose_are_animated(tmp_path):
    rng, (vertices, faces) = np.random.default_rng(0), sphere(1, 20.0)
    targets, weights = rng.normal(size=(2, len(vertices), 3)), rng.normal(size=(4, 2))
    turns = Rotation.random(3, random_state=1).as_matrix()
    poses = np.array([np.eye(4), *map(compose, turns, rng.normal(size=(3, 3)) * 30)])
    file, times = tmp_path / "a.glb", np.arange(4) / 25
    take = {"time_s": times, "targets": targets, "weights": weights, "pose": poses}
    write_glb(file, vertices, faces, take=take)
    assert trimesh.load_scene(file).geometry["face"].faces.shape == faces.shape
    base, moved, curves = moving(file)
    assert_allclose(curves["time_s"], times, rtol=1e-6)
    for t, pose in enumerate(poses):
        bent = base + np.tensordot(curves["weights"].reshape(4, 2)[t], moved, 1)
        placed = Rotation.from_quat(curves["rotation"][t]).apply(bent) + curves["translation"][t]
        true = transform_points(pose, vertices + np.tensordot(weights[t], targets, 1))
        assert_allclose(1000 * placed, true, atol=1e-3)
