"""Weights of a model's blendshapes on scans with an expression, and a person's own blendshapes."""

import re

import numpy as np
import pytest
from helpers.gltf import Gltf
from helpers.measures import row_lengths
from helpers.records import read_json

from scan2albedo import process
from scan2albedo.core import RawScan
from scan2albedo.errors import ModelError
from scan2albedo.geometry.rigid import rotation_from_vector, transform_points
from scan2albedo.io.linear_model_files import ARKIT_NAMES, LinearFaceModel

STEMS = "cheekPuff mouthPucker mouthFunnel mouthFrown browInnerUp browDown eyeBlink noseSneer jawOpen"


def test_names_become_arkits_in_its_order(tmp_path):
    names = ["jawOpen", "browInnerUp_R", "wink", "mouthSmile_L", "browInnerUp_L", "eyeBlinkRight"]
    vertices, faces = np.eye(4, 3), np.array([[0, 1, 2], [0, 2, 3]])
    model = {"mean": vertices, "basis": np.ones((4, 3, 1)), "faces": faces}
    model |= {"expression_basis": np.ones((4, 3, 6)), "expression_names": np.array(names)}
    np.savez(tmp_path / "own.npz", **model)
    shares = LinearFaceModel.load(tmp_path / "own.npz").arkit()
    assert list(shares) == ["eyeBlinkRight", "mouthSmileLeft", "jawOpen", "browInnerUp", "wink"]
    np.testing.assert_array_equal(shares["browInnerUp"], [0, 1, 0, 0, 1, 0])
    assert len(set(ARKIT_NAMES)) == 52
    np.savez(tmp_path / "short.npz", **model | {"expression_names": np.array(names[:5])})
    with pytest.raises(ModelError, match=r"short\.npz: expression_names has 5, expected 6"):
        LinearFaceModel.load(tmp_path / "short.npz")


@pytest.fixture(scope="module")
def ict(shared_data, tmp_path_factory):
    """Four people and nine expressions of ICT-FaceKit as a linear model's file, and their arrays."""
    shapes, moves = (np.load(shared_data / f"ict_{name}.npz") for name in ("faces", "expressions"))
    mean = shapes["shape_generic_neutral"].astype(float)
    people = np.stack([shapes[f"shape_person{k}"] - mean for k in (1, 2, 3, 4)], -1)
    stems = STEMS.split()
    keys = [re.sub("(?=[A-Z])", "_", stem).lower() for stem in stems]
    basis = np.stack([moves[key].astype(float) for key in keys], -1)
    path = tmp_path_factory.mktemp("ict") / "ict.npz"
    named = {"expression_basis": basis, "expression_names": np.array(stems)}
    np.savez(path, mean=mean, basis=people, faces=shapes["faces"], **named)
    return path, shapes, basis


def scan_of(face, shapes, seed):
    """A noisy scan of the face's own area, in another pose."""
    rng = np.random.default_rng(seed)
    turn = rotation_from_vector(rng.normal(0, 0.3, 3))
    moved = (face + rng.normal(0, 0.1, face.shape)) @ turn.T + rng.normal(0, 30, 3)
    return RawScan(moved, shapes["faces"][: int(shapes["face_area_faces"])])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_weights_of_mixtures_are_recovered(ict, seed):
    path, shapes, basis = ict
    rng = np.random.default_rng(seed)
    weights = np.zeros(basis.shape[2])
    weights[rng.choice(len(weights), 3, replace=False)] = rng.uniform(0.3, 0.9, 3)
    face = shapes[f"shape_person{seed + 1}"] + basis @ weights
    result = process(scan_of(face, shapes, seed), linear_model=path, quality="draft")
    found = result.linear_model.coefficients[4:]
    assert np.abs(found - weights).mean() < 0.03
    assert found.min() >= 0


@pytest.mark.slow
def test_a_neutral_scan_gives_the_persons_own_blendshapes(ict, tmp_path):
    path, shapes, _ = ict
    neutral = shapes["shape_person3"].astype(float)
    result = process(scan_of(neutral, shapes, 5), tmp_path, linear_model=path, quality="draft")
    fit = result.linear_model
    rest, targets, weights = fit.neutral_and_targets()
    assert max(weights) < 0.1
    # Into the truth's frame, by the fitted pose.
    made = rest + targets["browInnerUp"] + 0.5 * targets["jawOpen"]
    made = transform_points(fit.pose.inverse(), made)
    true = shapes["shape_person3_browInnerUp_L_browInnerUp_R_jawOpen0.5"]
    near = slice(int(shapes["face_area_vertices"]))
    assert row_lengths(made - true)[near].mean() < 0.6
    (mesh,) = Gltf.read(result.out / "template.glb").tree["meshes"]
    assert mesh["extras"]["targetNames"] == list(targets)
    np.testing.assert_allclose(mesh["weights"], weights)
    assert list(read_json(result.out / "coefficients.json")["blendshapes"]) == list(targets)
    known = [name for name in targets if name in ARKIT_NAMES]
    assert list(targets)[: len(known)] == sorted(known, key=ARKIT_NAMES.index)
