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
from scan2albedo.io.load_scan import file_sha256
from scan2albedo.io.npz import read_npz

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
class LinearFaceModel:
    """Faces x = mean + basis c of V vertices, coefficients c (K,) of unit variance, in any axes and unit.

    `mean` is (V, 3), `basis` (V, 3, K) float32 with the `shapes` directions of identity first, then those of
    expression; `faces` (F, 3), `uv` (F, 3, 2) of corners or None. The face may be posed by linear blend
    skinning about J `joints` with `parents` (J,), -1 for none, and `weights` (V, J): what a row lacks to 1
    stays. They lie at joint_mean + joint_basis c, (J, 3) and (J, 3, K); `pose_basis` (V, 3, 9 (J - 1)) are
    displacements by the entries of R - 1 of all joints but the first. Raises `ModelError` for shapes that
    disagree, numbers that are not finite, and indices beyond the vertices.
    """

    name: str
    sha256: str
    mean: FloatArray
    basis: RealArray
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
        count, joints, size = len(self.mean), len(self.joints), self.basis.shape[-1]
        expected: dict[str, tuple[int, ...]] = {"weights": (count, joints), "joint_basis": (joints, 3, size)}
        for name, shape in expected.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(shape))
        expected |= {"mean": (count, 3), "basis": (count, 3, size), "faces": (len(self.faces), 3)}
        expected |= {"parents": (joints,), "joint_mean": (joints, 3), "uv": (len(self.faces), 3, 2)}
        for name, shape in {**expected, "pose_basis": (count, 3, 9 * (joints - 1))}.items():
            if (array := getattr(self, name)) is not None:
                if array.shape != shape:
                    raise ModelError(f"{name} has shape {array.shape}, expected {shape}")
                if not all_finite(array):
                    raise ModelError(f"{name} holds NaN or infinite values")
        if (most := int(self.faces.max(initial=0))) >= count or not size * len(self.faces):
            said = f"{size} directions and {len(self.faces)} faces that point up to vertex {most}"
            raise ModelError(f"has {said}; expected some of both, and vertices 0 ... {count - 1}")
        if len(self.names) not in (0, size - self.shapes):
            raise ModelError(f"expression_names has {len(self.names)}, expected {size - self.shapes}")
        if not (self.parents < np.arange(joints)).all():
            raise ModelError(f"parents of joints must come before them, got {self.parents.tolist()}")

    def at(self, coefficients: FloatArray, rotations: FloatArray | None = None) -> FloatArray:
        """Return vertices (V, 3) by coefficients (K,) and rotation vectors (J, 3) of the joints [rad]."""
        turns = np.zeros((len(self.joints), 3)) if rotations is None else rotations
        return self.posed(coefficients, turns)[0]

    def posed(self, coefficients: FloatArray, rotations: FloatArray) -> tuple[FloatArray, ...]:
        """Return vertices x, T (V, 3, 3) and the slopes (J, 3, K) of the joints' shifts b by c.

        x_i = T_i v_i + sum_k w_ik b_k with v the shape, T_i = 1 + sum_k w_ik (R_k - 1), R_k the product of
        the rotations down to joint k, and b_k = b_p + (R_p - R_k) j_k with the parent p and the place j_k.
        """
        size = len(self.joints) + 1
        turn, shift = identities(size, 3), np.zeros((size, 3))  # the last: no parent
        slopes = np.zeros((size, 3, len(coefficients)))
        shape = self.mean + self.basis @ coefficients.astype(self.basis.dtype)  # no copy of a large basis
        places = self.joint_mean + self.joint_basis @ coefficients
        local = np.array([rotation_from_vector(vector) for vector in rotations]).reshape(-1, 3, 3)
        for joint, parent in enumerate(self.parents):
            turn[joint] = turn[parent] @ local[joint]
            left = turn[parent] - turn[joint]
            shift[joint] = shift[parent] + left @ places[joint]
            slopes[joint] = slopes[parent] + left @ self.joint_basis[joint]
        if self.pose_basis is not None:
            shape = shape + self.pose_basis @ (local[1:] - np.eye(3)).ravel()
        blend = np.eye(3) + np.tensordot(self.weights, turn[:-1] - np.eye(3), 1)
        return np.einsum("nij,nj->ni", blend, shape) + self.weights @ shift[:-1], blend, slopes[:-1]

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
        """Return the model of some vertices (N,), with a face that means nothing."""
        names = ("mean", "basis", "weights") + ("pose_basis",) * (self.pose_basis is not None)
        parts: Values = {name: getattr(self, name)[index].astype(float) for name in names}
        return replace(self, **parts, faces=np.zeros((1, 3), int), uv=None)

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


def model_fields(values: Values) -> Values:
    """Return a model's fields from the `values` of any layout; ModelError where one is missing or wrong."""
    found = {_NAMES[name]: value for name, value in values.items() if name in _NAMES and value is not None}
    if "tl" in found:  # Basel 2009 counts from one
        found["faces"] = _numbers(found, "tl") - 1
    if "cells" in found:
        found["faces"] = _numbers(found, "cells").T
    if "identity_basis" in found:  # `MorphableShapeModel`: (K, V, 3), of unit variance
        found["basis"] = np.moveaxis(_numbers(found, "identity_basis"), 0, -1)
        found["expression_basis"] = np.moveaxis(_numbers(found, "expression_basis"), 0, -1)
    mean = _numbers(found, "mean").reshape(-1, 3)
    parts = []
    for own in ("", "expression_"):
        if own and "expression_basis" not in found:
            continue
        basis = _numbers(found, f"{own}basis")
        if basis.size % mean.size or len(basis) not in (mean.size, len(mean)):
            raise ModelError(f"{own}basis has shape {basis.shape}, expected ({len(mean)}, 3, K) as the mean")
        basis = basis.reshape(*mean.shape, -1)
        wanted, name = basis.shape[2:], f"{own}deviation"
        if f"{own}variance" in found:
            found[name] = np.sqrt(_numbers(found, f"{own}variance"))
        deviation = _numbers({name: np.ones(wanted), **found}, name).ravel()
        if deviation.shape != wanted or not (deviation >= 0).all():
            raise ModelError(f"{name} has shape {deviation.shape}, expected {wanted}, 0 or more")
        parts.append((basis * deviation).astype(np.float32))
    if "expression_mean" in found:  # Basel 2017: the mean face has the mean expression
        mean = mean + _numbers(found, "expression_mean").reshape(-1, 3)
    fields: Values = {"mean": mean, "basis": np.concatenate(parts, axis=2), "shapes": parts[0].shape[2]}
    if "v_template" in values:  # FLAME's expressions follow its shapes
        fields["shapes"] = min(fields["shapes"], 300)
    fields["names"] = _texts(found.get("expression_names", ()))
    faces = fields["faces"] = _numbers(found, "faces", whole=True)
    if "uv" in found:
        fields["uv"] = uv = _numbers(found, "uv")
        if uv.ndim == 2:
            fields["uv"] = uv[_numbers({"uv_faces": faces, **found}, "uv_faces", whole=True)]
    if "kintree_table" in found:
        parents = _numbers(found, "kintree_table")[0]
        found["joint_parents"] = np.where(parents < len(parents), parents, -1)
        flame = "root", "neck", "jaw", "left_eye", "right_eye"
        found["joints"] = flame if len(parents) == len(flame) else range(len(parents))
    if "joints" in found:
        joints = fields["joints"] = _texts(found["joints"])
        fields["parents"] = np.ravel(found.get("joint_parents", np.full(len(joints), -1))).astype(int)
        fields["weights"] = _numbers(found, "skinning_weights")
        if "joint_regressor" in found:
            regressor = _numbers(found, "joint_regressor")
            fields["joint_mean"] = regressor @ mean
            fields["joint_basis"] = np.tensordot(regressor, fields["basis"], 1)
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
    return array.astype(np.int64 if whole else np.float64)


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
