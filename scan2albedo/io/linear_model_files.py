"""Linear (morphable) models of faces in files: FLAME, Basel, Surrey, anyone's own. Nothing in them runs."""

import math
import pickle
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy import sparse
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from scan2albedo.core.arrays import (
    ArrayLike,
    Float32Array,
    FloatArray,
    IntArray,
    RealArray,
    Texts,
    Values,
    all_finite,
    identities,
)
from scan2albedo.errors import ModelError, ScanError, needs_extra, one_line
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.io import limits
from scan2albedo.io.input_hash import file_sha256
from scan2albedo.io.npz import read_npz
from scan2albedo.statistics.linear_model import LinearModel

_LAYOUTS = """mean v_template shapeMU shape/model/mean, basis shapedirs shapePC shape/model/pcaBasis,
deviation shapeEV, variance shape/model/pcaVariance, faces f, cells shape/representer/cells, tl,
expression_mean expression/model/mean, expression_basis expression/model/pcaBasis, expression_deviation,
expression_variance expression/model/pcaVariance, expression_names, identity_basis, uv vt, uv_faces ft,
skinning_weights weights, joints, joint_parents, joint_positions, joint_regressor J_regressor, kintree_table,
pose_basis posedirs"""
_NAMES = {name: entry.split()[0] for entry in _LAYOUTS.split(",") for name in entry.split()}
"""Our names of arrays, then those in FLAME, Basel 2009, and Basel 2017 and later."""
_ADVICE = "give a model in one of the layouts that docs/face_model.md lists"

_SIDED = """eyeBlink eyeLookDown eyeLookIn eyeLookOut eyeLookUp eyeSquint eyeWide jaw mouth mouthSmile
    mouthFrown mouthDimple mouthStretch mouthPress mouthLowerDown mouthUpperUp browDown browOuterUp
    cheekSquint noseSneer"""
_SINGLE = """jawForward jawOpen mouthClose mouthFunnel mouthPucker mouthRollLower mouthRollUpper
    mouthShrugLower mouthShrugUpper browInnerUp cheekPuff tongueOut"""
ARKIT_NAMES = (*(name + side for name in _SIDED.split() for side in ("Left", "Right")), *_SINGLE.split())
"""The 52 blendshapes of ARKit."""


@dataclass(frozen=True, eq=False)
class LinearFaceModel(LinearModel):
    """Faces of V vertices, a mean (V, 3) and directions (K, V, 3), in any axes and unit.

    The first `shapes` directions are of identity, those after them of expression; `faces` (F, 3), `uv`
    (F, 3, 2) of corners or None. The face may be posed by linear blend skinning about J `joints` with
    `parents` (J,), -1 for none, and `weights` (V, J): what a row lacks to 1 stays. Their places have the mean
    `joint_mean` (J, 3) and the directions `joint_basis` (K, J, 3); `pose_basis` (V, 3, 9 (J - 1)) are
    displacements by the entries of R - 1 of all joints but the first. Raises `ModelError` for shapes that
    disagree, numbers that are not finite, and indices beyond the vertices.
    """

    name: str
    sha256: str
    shapes: int
    faces: IntArray
    uv: FloatArray | None = None
    joints: Texts = ()
    parents: IntArray = field(default_factory=lambda: np.zeros(0, int))
    weights: FloatArray = None  # type: ignore[assignment]
    joint_mean: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    joint_basis: FloatArray = None  # type: ignore[assignment]
    pose_basis: FloatArray | None = None
    names: Texts = ()
    mm_per_unit: float = 1.0
    """Found where the mean is placed on a face."""

    def __post_init__(self) -> None:
        count = len(self.mean)
        joints = len(self.joints)
        expected: dict[str, tuple[int, ...]] = {
            "mean": (count, 3),
            "basis": (self.components, count, 3),
            "faces": (len(self.faces), 3),
            "uv": (len(self.faces), 3, 2),
            "parents": (joints,),
            "weights": (count, joints),
            "joint_mean": (joints, 3),
            "joint_basis": (self.components, joints, 3),
            "pose_basis": (count, 3, 9 * (joints - 1)),
        }
        for name in ("weights", "joint_basis"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(expected[name]))
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ModelError(f"{name} has shape {array.shape}, expected {shape}")
            if array is not None and not all_finite(array):
                raise ModelError(f"{name} holds NaN or infinite values")
        most = int(self.faces.max(initial=0))
        if most >= count or not self.components * len(self.faces):
            said = f"{self.components} directions and {len(self.faces)} faces that point up to vertex {most}"
            raise ModelError(f"has {said}; expected some of both, and vertices 0 ... {count - 1}")
        expressions = self.components - self.shapes
        if len(self.names) not in (0, expressions):
            raise ModelError(f"expression_names has {len(self.names)}, expected {expressions}")
        if not (self.parents < np.arange(joints)).all():
            raise ModelError(f"parents of joints must come before them, got {self.parents.tolist()}")

    @property
    def joint_places(self) -> LinearModel:
        """Of the joints, (J, 3), in the face at rest."""
        return LinearModel(self.joint_mean, self.joint_basis)

    def at(self, coefficients: ArrayLike, rotations: FloatArray | None = None) -> FloatArray:
        """Return vertices (V, 3) by coefficients (K,) and rotation vectors (J, 3) of the joints [rad]."""
        shape = super().at(coefficients)
        if rotations is None:
            return shape
        return self._skinned(self._bent(shape, rotations), self.joint_places.at(coefficients), rotations)

    def turned(self, rotations: FloatArray) -> LinearModel:
        """Return the linear model that this one is while its joints are turned by vectors (J, 3) [rad]."""
        basis = self._skinned(_by_vertex(self.basis), _by_vertex(self.joint_basis), rotations)
        mean = self._skinned(self._bent(self.mean, rotations), self.joint_mean, rotations)
        return LinearModel(mean, basis.transpose(2, 0, 1))

    def _bent(self, shape: FloatArray, rotations: FloatArray) -> FloatArray:
        if self.pose_basis is None:
            return shape
        turns = np.array([rotation_from_vector(vector) for vector in rotations[1:]])
        return shape + self.pose_basis @ (turns - np.eye(3)).ravel()

    def _skinned(self, shape: RealArray, places: RealArray, rotations: FloatArray) -> FloatArray:
        """Return vertices (V, 3, ...), with joints at `places` (J, 3, ...), after linear blend skinning.

        x_i = T_i v_i + sum_k w_ik b_k with T_i = 1 + sum_k w_ik (R_k - 1), R_k the product of the rotations
        down to joint k, and b_k = b_p + (R_p - R_k) j_k with the parent p and the place j_k.
        """
        size = len(self.joints) + 1  # the last: no parent
        turns = identities(size, 3)
        shifts = np.zeros((size, *places.shape[1:]))
        for joint, parent in enumerate(self.parents):
            turns[joint] = turns[parent] @ rotation_from_vector(rotations[joint])
            shifts[joint] = shifts[parent] + (turns[parent] - turns[joint]) @ places[joint]
        blend = np.eye(3) + np.tensordot(self.weights, turns[:-1] - np.eye(3), 1)
        return np.einsum("nij,nj...->ni...", blend, shape) + np.tensordot(self.weights, shifts[:-1], 1)

    def arkit(self) -> dict[str, FloatArray]:
        """Return ARKit's names of the model's blendshapes, in ARKit's order, with shares (K - shapes,).

        A side's suffix _L or _R is ARKit's Left or Right; sides of what ARKit has once are joined. Names that
        ARKit has not come last.

        .. [1] Apple, "ARFaceAnchor.BlendShapeLocation", ARKit's documentation.
        """
        shares = dict[str, FloatArray]()
        for k, name in enumerate(self.names):
            stem, side = (name[:-2], name[-2:]) if name.endswith(("_L", "_R")) else (name, "")
            sided = stem + {"_L": "Left", "_R": "Right", "": ""}[side]
            known = sided if sided in ARKIT_NAMES else stem if stem in ARKIT_NAMES else name
            shares.setdefault(known, np.zeros(len(self.names)))[k] = 1.0
        return dict(sorted(shares.items(), key=lambda entry: (*ARKIT_NAMES, entry[0]).index(entry[0])))

    def of_vertices(self, index: IntArray) -> Self:
        """Return the model of some vertices (N,) in double precision, with a face that means nothing."""
        rows = np.ascontiguousarray(_by_vertex(self.basis)[index], float)
        return replace(
            self,
            mean=self.mean[index],
            basis=rows.transpose(2, 0, 1),  # read vertex by vertex, all coefficients at once
            weights=self.weights[index],
            pose_basis=None if self.pose_basis is None else self.pose_basis[index],
            faces=np.zeros((1, 3), int),
            uv=None,
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a model, whatever its layout; raises `ModelError`, naming the file, for anything else.

        `MissingDependencyError` where HDF5 needs h5py. A pickle is read as inert data: numpy and scipy arrays
        and the values of chumpy; any other name in it is refused, and no code of the file or of those runs.
        """
        try:
            return cls._load(Path(path), Path(path).stat().st_mtime_ns)
        except (ModelError, ScanError, MatReadError, pickle.UnpicklingError, *limits.DAMAGE) as error:
            said = one_line(error).removeprefix(f"linear model {path} ").removesuffix(f"; {_ADVICE}")
            raise ModelError(f"linear model {path}: {said}; {_ADVICE}") from error

    @classmethod
    @lru_cache(maxsize=1)
    def _load(cls, file: Path, changed: int) -> Self:
        limits.require_file(file, 4 * limits.FILE_BYTES)
        return cls(name=file.stem, sha256=file_sha256(file), **model_fields(stored_arrays(file)))


def _by_vertex(basis: RealArray) -> RealArray:
    """Return directions (K, V, 3) as (V, 3, K)."""
    return basis.transpose(1, 2, 0)


def model_fields(values: Values) -> Values:
    """Return a model's fields from the `values` of any layout; ModelError where one is missing or wrong."""
    found = {_NAMES[name]: value for name, value in values.items() if name in _NAMES and value is not None}
    if "tl" in found:  # Basel 2009 counts from one
        found["faces"] = _numbers(found, "tl") - 1
    if "cells" in found:
        found["faces"] = _numbers(found, "cells").T
    mean = _numbers(found, "mean").reshape(-1, 3)
    basis = _scaled_basis(found, mean, "")
    shapes = len(basis)
    if "expression_basis" in found:
        basis = np.concatenate([basis, _scaled_basis(found, mean, "expression_")])
    elif "v_template" in values:  # FLAME's expressions follow its shapes
        shapes = min(shapes, 300)
    if "expression_mean" in found:  # Basel 2017: the mean face has the mean expression
        mean = mean + _numbers(found, "expression_mean").reshape(-1, 3)
    faces = _numbers(found, "faces", whole=True)
    fields: Values = {"mean": mean, "basis": basis, "shapes": shapes, "faces": faces}
    fields["names"] = _texts(found.get("expression_names", ()))
    if "uv" in found:
        uv = _numbers(found, "uv")
        corners = _numbers({"uv_faces": faces, **found}, "uv_faces", whole=True)
        fields["uv"] = uv[corners] if uv.ndim == 2 else uv
    return fields | _joint_fields(found, mean, basis)


def _scaled_basis(found: Values, mean: FloatArray, prefix: str) -> Float32Array:
    """Return the directions (K, V, 3) of unit variance, of identity or with the `prefix` of expressions."""
    if "identity_basis" in found:  # `MorphableShapeModel`: (K, V, 3), of unit variance
        return _numbers(found, f"{prefix or 'identity_'}basis").astype(np.float32)
    stored = _numbers(found, f"{prefix}basis")
    if stored.size % mean.size or len(stored) not in (mean.size, len(mean)):
        raise ModelError(f"{prefix}basis has shape {stored.shape}, expected ({len(mean)}, 3, K) as the mean")
    basis = np.moveaxis(stored.reshape(*mean.shape, -1), -1, 0)
    deviation = np.ones(len(basis))
    if f"{prefix}variance" in found:
        deviation = np.sqrt(_numbers(found, f"{prefix}variance")).ravel()
    elif f"{prefix}deviation" in found:
        deviation = _numbers(found, f"{prefix}deviation").ravel()
    if deviation.shape != basis.shape[:1] or not (deviation >= 0).all():
        raise ModelError(
            f"{prefix}deviation has shape {deviation.shape}, expected {basis.shape[:1]}, 0 or more"
        )
    return (basis * deviation[:, None, None]).astype(np.float32)


def _joint_fields(found: Values, mean: FloatArray, basis: Float32Array) -> Values:
    """Return the fields of joints, none where the model has no joints."""
    if "kintree_table" in found:
        parents = _numbers(found, "kintree_table")[0]
        found["joint_parents"] = np.where(parents < len(parents), parents, -1)
        flame = ("root", "neck", "jaw", "left_eye", "right_eye")
        found["joints"] = flame if len(parents) == len(flame) else range(len(parents))
    if "joints" not in found:
        return {}
    joints = _texts(found["joints"])
    fields: Values = {"joints": joints, "weights": _numbers(found, "skinning_weights")}
    fields["parents"] = np.ravel(found.get("joint_parents", np.full(len(joints), -1))).astype(int)
    if "joint_regressor" in found:
        regressor = _numbers(found, "joint_regressor")
        fields["joint_mean"] = regressor @ mean
        fields["joint_basis"] = regressor @ basis
    else:
        fields["joint_mean"] = _numbers(found, "joint_positions")
    if "pose_basis" in found:
        fields["pose_basis"] = _numbers(found, "pose_basis")
    return fields


def _texts(names: Iterable[Any]) -> Texts:
    return tuple(name.decode() if isinstance(name, bytes) else str(name) for name in names)


def _numbers(values: Values, name: str, *, whole: bool = False) -> Any:
    """Return an array of numbers as float64, or as whole ones; ModelError where there is none."""
    if name not in values:
        raise ModelError(f"has no {name}, nor what other layouts call it")
    array = np.asarray(values[name])
    if array.dtype.kind not in "fiu" or (whole and ((array < 0) | (array != np.floor(array))).any()):
        raise ModelError(f"{name} holds {array.dtype} {array.shape}, expected {'whole ' * whole}numbers")
    return array.astype(np.int64 if whole else float)


def stored_arrays(file: Path) -> Values:
    """Return the arrays that a model's `file` holds, by their names in it; ModelError for other endings."""
    ending = file.suffix.lower()
    if ending == ".npz":
        return read_npz(file, (), optional=_NAMES, what="linear model", advice=_ADVICE, error=ModelError)
    if ending == ".mat":
        return dict(loadmat(file, variable_names=tuple(_NAMES)))
    if ending in (".h5", ".hdf5"):
        with needs_extra("hdf5"):
            import h5py
        with h5py.File(file, "r") as stored:
            return {name: stored[name][()] for name in _NAMES if name in stored}
    if ending == ".bin":
        return eos_arrays(file.read_bytes())
    if ending != ".pkl":
        raise ModelError(f"ends in {ending!r}, expected .npz, .h5, .hdf5, .mat, .pkl or .bin")
    with file.open("rb") as opened:
        found = _Unpickler(opened, encoding="latin1").load()
    if not isinstance(found, dict):
        raise ModelError(f"the pickle holds a {type(found).__name__}, expected a dict of arrays")
    return {name: _plain(found[name]) for name in _NAMES if name in found}


def eos_arrays(data: bytes) -> Values:
    """Return the shape model in an eos file, Surrey's: a cereal archive of MorphableModel since version 1.

    uint32 version; then mean, one or two bases (scaled, orthonormal), eigenvalues, each as int32 rows, int32
    columns and column-major float32; then uint64 count and int32 triples of vertices.
    """
    begin = 4
    matrices = list[Float32Array]()
    while not matrices or len(matrices[-1]) == len(matrices[0]):
        rows, columns = np.frombuffer(data, "<i4", 2, begin).tolist()
        if min(rows, columns) < 1 or len(matrices) > 3:
            raise ModelError("is no eos model: it holds no shape, or eos before version 0.12 wrote it")
        matrices.append(np.frombuffer(data, "<f4", rows * columns, begin + 8).reshape(columns, rows).T)
        begin += 8 + 4 * rows * columns
    count = int(np.frombuffer(data, "<u8", 1, begin)[0])
    mean, *bases, variance = matrices
    deviation = np.sqrt(variance) if len(bases) == 1 else np.ones_like(variance)
    faces = np.frombuffer(data, "<i4", 3 * count, begin + 8).reshape(-1, 3)
    return {"mean": mean, "basis": bases[0], "deviation": deviation, "faces": faces}


class _Inert:
    """Stands for an object of a pickle: keeps what it is made with and set to, and runs nothing."""

    arguments: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *arguments: Any) -> Self:
        made = super().__new__(cls)
        made.arguments = arguments
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state


_READ = """ndarray dtype _reconstruct scalar _frombuffer csc_matrix csr_matrix csc_array csr_array Ch
_reconstructor object set"""
_CLASSES = {name: type(name, (_Inert,), {}) for name in _READ.split()}


class _Unpickler(pickle._Unpickler):
    """Reads a pickle whose only objects are inert. In Python: a hostile memo index makes C's fill memory."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a global; `UnpicklingError` for names that are no array's."""
        homes = ("numpy", "scipy", "chumpy", "copy_reg", "copyreg", "__builtin__", "builtins")
        if name in _CLASSES and module.partition(".")[0] in homes:
            return _CLASSES[name]
        if (module, name) == ("_codecs", "encode"):  # bytes, as protocol 2 writes them
            return lambda text, _: text.encode("latin1")
        raise pickle.UnpicklingError(
            f"the pickle asks for {module}.{name}, but only arrays of numpy, scipy and chumpy are read, and "
            "nothing of it was run: save the model's arrays as .npz"
        )


def _plain(value: Any) -> Any:
    """Return the array that an object of a pickle stands for, or the object."""
    if not isinstance(value, _Inert):
        return value
    kind, state = type(value).__name__, value.state
    if kind == "_reconstructor":  # of (class, base, state of the base)
        kind = value.arguments[0].__name__
    if kind == "Ch":
        return _plain(state["x"])
    if kind[:4] in ("csc_", "csr_"):
        parts = tuple(_plain(state[part]) for part in ("data", "indices", "indptr"))
        shape = state.get("_shape", state.get("shape"))
        limits.require_at_most("J_regressor", "entries", math.prod(shape), limits.VERTICES, _ADVICE)
        return (sparse.csc_matrix if kind[:4] == "csc_" else sparse.csr_matrix)(parts, shape).toarray()
    if kind == "_frombuffer":
        raw, dtype, shape, order = value.arguments
    elif kind in ("ndarray", "_reconstruct"):
        _, shape, dtype, fortran, raw = state
        order = "F" if fortran else "C"
    else:
        raise ModelError(f"holds a {kind} where an array is expected")
    number = np.dtype(dtype.arguments[0])
    if number.kind not in "fiub":
        raise ModelError(f"holds an array of {number}, expected numbers")
    if dtype.state is not None and dtype.state[1] in "<>":
        number = number.newbyteorder(dtype.state[1])
    data = raw.encode("latin1") if isinstance(raw, str) else raw
    return np.frombuffer(data, number).reshape(shape, order=order)
