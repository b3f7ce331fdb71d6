"""Linear models are read from every layout as the same numbers; pickles run nothing; faults name the file."""

import os
import pickle
import struct
import sys
import types

import numpy as np
import pytest
from helpers.npz import rewritten
from numpy.testing import assert_allclose, assert_array_equal
from scipy import sparse
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from scan2albedo.errors import MissingDependencyError, ModelError
from scan2albedo.geometry.rigid import compose, transform_points
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.reflectance.shape_model import MorphableShapeModel

V = 12
K = 3
E = 2
RNG = np.random.default_rng(0)
MEAN = RNG.normal(size=(V, 3))
BASIS = RNG.normal(size=(V, 3, K))
EXPRESSION = RNG.normal(size=(V, 3, E))
BOTH = np.concatenate([BASIS, EXPRESSION], axis=2)
DEVIATION = np.array([3.0, 2.0, 0.5])
FACES = np.array([[0, 1, 2], [2, 3, 4], [5, 6, 11]])
WEIGHTS = RNG.dirichlet(np.ones(5), V)
REGRESSOR, POSE = RNG.dirichlet(np.ones(V), 5), RNG.normal(size=(V, 3, 36)) / 100
PARENTS = np.array([4294967295, 0, 1, 1, 1])
OWN = {
    "mean": MEAN,
    "basis": BASIS,
    "deviation": DEVIATION,
    "faces": FACES,
    "expression_basis": EXPRESSION.reshape(3 * V, E),
}


def orthonormal(values):
    return np.linalg.qr(values.reshape(3 * V, -1))[0]


def load(path, data):
    path.write_bytes(data)
    return LinearFaceModel.load(path)


def assert_same(model, basis, shapes):
    assert_allclose(model.mean, MEAN, rtol=1e-6)
    assert_allclose(model.basis, np.moveaxis(basis, 2, 0), rtol=1e-5, atol=1e-6)
    assert_array_equal(model.faces, FACES)
    assert model.shapes == shapes
    assert len(model.sha256) == 64


def test_own_layout_scales_directions_to_unit_variance(tmp_path):
    uv, uv_faces = RNG.random((7, 2)), np.array([[0, 1, 2], [3, 4, 5], [6, 0, 1]])
    np.savez(tmp_path / "own.npz", **OWN, uv=uv, uv_faces=uv_faces)
    model = LinearFaceModel.load(tmp_path / "own.npz")
    assert_same(model, np.concatenate([BASIS * DEVIATION, EXPRESSION], axis=2), K)
    assert model.name == "own"
    assert_array_equal(model.uv, uv[uv_faces])


def test_morphable_shape_models_of_ours_are_read(tmp_path):
    MorphableShapeModel(MEAN, np.moveaxis(BOTH, 2, 0), K, FACES, np.zeros(68, int)).save(
        tmp_path / "ours.npz"
    )
    assert_same(LinearFaceModel.load(tmp_path / "ours.npz"), BOTH, K)


def test_basel_2009_counts_vertices_from_one_and_has_standard_deviations(tmp_path):
    basis = orthonormal(BASIS)
    arrays = {"shapeMU": MEAN.reshape(-1, 1), "shapePC": basis, "shapeEV": DEVIATION.reshape(-1, 1)}
    savemat(tmp_path / "01_MorphableModel.mat", arrays | {"tl": FACES + 1.0, "texMU": np.zeros((3 * V, 1))})
    model = LinearFaceModel.load(tmp_path / "01_MorphableModel.mat")
    assert_same(model, (basis * DEVIATION).reshape(V, 3, K), K)


def test_basel_2017_adds_the_mean_expression(tmp_path):
    basis, expression = orthonormal(BASIS), orthonormal(EXPRESSION)
    arrays = {
        "shape/model/mean": MEAN.ravel() - 1,
        "shape/model/pcaBasis": basis,
        "shape/model/pcaVariance": DEVIATION**2,
        "expression/model/mean": np.ones(3 * V),
        "expression/model/pcaBasis": expression,
        "expression/model/pcaVariance": np.array([4.0, 1.0]),
        "shape/representer/cells": FACES.T,
        "shape/representer/points": MEAN.T,
    }
    both = np.concatenate([basis * DEVIATION, expression * [2, 1]], axis=1).reshape(V, 3, K + E)
    assert_same(hdf5(tmp_path / "bfm.h5", arrays), both, K)


def hdf5(path, arrays):
    """Write arrays by their names, and return the model that is read of them."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array
    return LinearFaceModel.load(path)


def test_own_layout_in_hdf5_with_joints(tmp_path):
    joints = {"joints": ["neck", "jaw"], "skinning_weights": WEIGHTS[:, :2], "joint_parents": [-1, 0]}
    model = hdf5(tmp_path / "own.h5", OWN | joints | {"joint_positions": np.eye(3)[:2]})
    assert model.joints == ("neck", "jaw")
    assert_array_equal(model.joint_mean, np.eye(3)[:2])


def test_hdf5_without_its_library_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'scan2albedo\[hdf5\]'"):
        load(tmp_path / "bfm.h5", b"\x89HDF")


def eos_bytes(*matrices):
    parts = [struct.pack("<I", 1)]
    for matrix in matrices:
        parts += [struct.pack("<ii", *matrix.shape), matrix.astype("<f4").tobytes(order="F")]
    parts += [struct.pack("<Q", len(FACES)), FACES.astype("<i4").tobytes()]
    # The colour model, which is empty, and whatever follows.
    return b"".join(parts) + struct.pack("<iiiiiiQ", 0, 1, 0, 0, 0, 1, 0) + bytes(64)


@pytest.mark.parametrize("scaled_too", [False, True])
def test_eos_models_hold_column_major_matrices(tmp_path, scaled_too):
    basis, mean, variance = orthonormal(BASIS), MEAN.reshape(-1, 1), DEVIATION.reshape(-1, 1) ** 2
    bases = [basis * DEVIATION, basis] if scaled_too else [basis]
    model = load(tmp_path / "sfm.bin", eos_bytes(mean, *bases, variance))
    assert_same(model, (basis * DEVIATION).reshape(V, 3, K), K)


class Ch:
    """Pickled as chumpy's is: a dictionary with the value as x."""

    def __init__(self, x):
        self.x = x

    def __getstate__(self):
        return {"x": self.x, "_dirty_vars": set(), "_itr": None}


def flame(monkeypatch, **changes):
    """Return FLAME's dictionary; its Ch pickles under chumpy's name."""
    module = types.ModuleType("chumpy.ch")
    module.Ch = Ch
    monkeypatch.setattr(Ch, "__module__", "chumpy.ch")
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    return {
        "v_template": Ch(MEAN),
        "shapedirs": Ch(BOTH),
        "f": FACES.astype(np.uint32),
        "weights": WEIGHTS,
        "J_regressor": sparse.csc_matrix(REGRESSOR),
        "kintree_table": np.stack([PARENTS, np.arange(5)]).astype(np.uint32),
        "posedirs": POSE,
        "bs_type": "lrotmin",
        "bs_style": "lbs",
        "J": Ch(REGRESSOR @ MEAN),
        **changes,
    }


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_flame_is_read_without_chumpy(tmp_path, monkeypatch, protocol):
    text = pickle.dumps(flame(monkeypatch), protocol)
    for name in ("chumpy", "chumpy.ch"):
        monkeypatch.setitem(sys.modules, name, None)
    model = load(tmp_path / "generic_model.pkl", text)
    assert_same(model, BOTH, K + E)  # below 300 all are shape
    assert model.joints == ("root", "neck", "jaw", "left_eye", "right_eye")
    assert model.parents.tolist() == [-1, 0, 1, 1, 1]
    assert_allclose(model.joint_mean, REGRESSOR @ MEAN)


def test_flame_of_python_2_is_read(tmp_path):
    """NumPy of Python 2 wrote protocol 2 with bytes as text and the module names of its time."""
    reduced = pickle.dumps({"v_template": MEAN, "shapedirs": BASIS, "f": FACES}, 2)
    reduced = reduced.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert b"numpy.core.multiarray" in reduced
    assert_same(load(tmp_path / "m.pkl", reduced), BASIS, K)


def test_flame_follows_the_skinning_of_smpl(tmp_path, monkeypatch):
    """Against a plain evaluation with 4 x 4 matrices along the chain (Loper et al., SMPL, 2015)."""
    model = load(tmp_path / "m.pkl", pickle.dumps(flame(monkeypatch)))
    c, vectors = RNG.normal(size=K + E), 0.3 * RNG.normal(size=(5, 3))
    turns = Rotation.from_rotvec(vectors).as_matrix()
    shaped = MEAN + BOTH @ c
    joints = REGRESSOR @ shaped
    posed = shaped + POSE @ (turns[1:] - np.eye(3)).ravel()
    world, expected = [], np.zeros_like(posed)
    for k, parent in enumerate([-1, 0, 1, 1, 1]):
        local = compose(turns[k], joints[k] - (joints[parent] if k else 0))
        world.append(local if k == 0 else world[parent] @ local)
        expected += WEIGHTS[:, k : k + 1] * transform_points(world[k], posed - joints[k])
    assert_allclose(model.at(c, vectors), expected, atol=1e-6)


class Hostile:
    """Runs a command when it is unpickled by pickle.load."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_hostile_pickles_run_nothing(tmp_path, monkeypatch, protocol):
    made = str(tmp_path / "made")
    hostile = pickle.dumps(flame(monkeypatch, extra=Hostile(made)), protocol)
    with pytest.raises(ModelError, match=r"bad\.pkl: the pickle asks for (posix|os|nt)\.mkdir"):
        load(tmp_path / "bad.pkl", hostile)
    assert not os.path.exists(made)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"mean": None}, "has no mean"),
        ({"faces": None}, "has no faces"),
        ({"mean": np.where(np.arange(3 * V).reshape(V, 3) == 10, np.nan, MEAN)}, "mean holds NaN"),
        ({"basis": BASIS[:-1]}, r"basis has shape \(11, 3, 3\), expected \(12, 3, K\)"),
        ({"deviation": DEVIATION[:2]}, r"deviation has shape \(2,\), expected \(3,\)"),
        ({"deviation": -DEVIATION}, "0 or more"),
        ({"expression_basis": EXPRESSION.ravel()[:5]}, "expression_basis has shape"),
        ({"faces": FACES + 1}, r"point up to vertex 12; expected some of both, and vertices 0 \.\.\. 11"),
        ({"faces": FACES + 0.5}, "whole numbers"),
        ({"mean": np.array(["a"])}, r"mean holds <U1 \(1,\), expected numbers"),
        ({"uv": np.zeros((3, 2))}, "index 3 is out of bounds for axis 0 with size 3"),
        ({"joints": ["jaw"], "skinning_weights": WEIGHTS[:, :1]}, "has no joint_positions"),
        ({"joints": ["jaw"], "skinning_weights": WEIGHTS, "joint_positions": MEAN[:1]}, "weights has shape"),
    ],
)
def test_faults_are_one_error_that_names_the_file(tmp_path, changes, said):
    np.savez(tmp_path / "own.npz", **OWN)
    rewritten(tmp_path / "own.npz", **changes)
    with pytest.raises(ModelError, match=rf"linear model .*own\.npz: .*{said}.*face_model\.md") as caught:
        LinearFaceModel.load(tmp_path / "own.npz")
    assert str(caught.value).count("own.npz") == 1


CODE = (
    b"cbuiltins\neval\n(S'1'\ntR.",
    b"cnumpy\nload\n(S'x'\ntR.",
    b"cscipy\nsparse.os.system\n(S'true'\ntR.",
    b"c__builtin__\ngetattr\n(cnumpy\nndarray\nS'__class__'\ntR.",
    b"ccopyreg\n__newobj__\n.",
    b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(dS'a'\ncos\nsystem\nsb.",
)
OTHER_FILES = [
    (name, content, "")
    for name in ("m.npz", "m.mat", "m.pkl", "m.bin")
    for content in (b"", b"PK\x03\x04 no model", b"x" * 300, bytes(301))
]
OTHER_FILES += [("m.pkl", text, "the pickle asks for") for text in CODE]
EOS = eos_bytes(MEAN.reshape(-1, 1), orthonormal(BASIS), DEVIATION.reshape(-1, 1))
OTHER_FILES += [("m.bin", EOS[:size], "") for size in (2, 9, 90, 400)]
OBJECTS = pickle.dumps({"v_template": np.array([{}], object)})
OTHER_FILES += [
    ("m.pkl", b"\x80\x04}r\xff\xff\xff\x7f.", "has no mean"),  # a memo that would fill memory
    ("m.pkl", OBJECTS, "holds an array of object, expected numbers"),
    ("m.pkl", pickle.dumps({"v_template": MEAN})[:-20], ""),
    ("m.fbx", b"x", r"ends in '\.fbx', expected \.npz"),
    ("m.npz", None, "No such file"),
]


@pytest.mark.parametrize(("name", "content", "said"), OTHER_FILES, ids=range(len(OTHER_FILES)))
def test_other_files_are_named(tmp_path, name, content, said):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ModelError, match=rf"linear model .*{name}: {said}"):
        LinearFaceModel.load(tmp_path / name)
