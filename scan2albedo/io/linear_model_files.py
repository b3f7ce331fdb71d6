"""Linear (morphable) models of faces in files: FLAME, Basel, Surrey, anyone's own. Nothing in them runs."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ModelError, ScanError, needs_extra, one_line
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.io import limits
from scan2albedo.io.load_scan import file_sha256
from scan2albedo.io.npz import read_npz

Values = dict[str, Any]
_LISTS = "shape/model/", "expression/model/"
_NAMES = (
    *("mean", "basis", "deviation", "expression_basis", "expression_deviation", "faces", "uv", "uv_faces"),
    *("joints", "joint_parents", "joint_positions", "joint_regressor", "skinning_weights", "pose_basis"),
    *("v_template", "shapedirs", "f", "vt", "ft", "weights", "kintree_table", "J_regressor", "posedirs"),
    *("shapeMU", "shapePC", "shapeEV", "tl", "identity_basis", "shape/representer/cells"),
    *(f"{part}{name}" for part in _LISTS for name in ("mean", "pcaBasis", "pcaVariance")),
)
"""Arrays of all layouts, all that is read of a file."""
_ADVICE = "give a model in one of the layouts that docs/face_model.md lists"
FLAME_SHAPES, FLAME_JOINTS = 300, ("root", "neck", "jaw", "left_eye", "right_eye")
"""Shape directions of FLAME, which its expressions follow, and its joints in their order."""


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
    basis: NDArray[np.floating]
    shapes: int
    faces: IntArray
    uv: FloatArray | None = None
    joints: tuple[str, ...] = ()
    parents: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    weights: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    joint_mean: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    joint_basis: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 0)))
    pose_basis: FloatArray | None = None

    def __post_init__(self) -> None:
        count, joints, size = len(self.mean), len(self.joints), self.basis.shape[-1]
        expected = {"mean": (count, 3), "basis": (count, 3, size), "faces": (len(self.faces), 3)}
        if self.uv is not None:
            expected["uv"] = (len(self.faces), 3, 2)
        if not joints:
            object.__setattr__(self, "weights", np.zeros((count, 0)))
            object.__setattr__(self, "joint_basis", np.zeros((0, 3, size)))
        else:
            expected |= {"parents": (joints,), "weights": (count, joints), "joint_mean": (joints, 3)}
            expected["joint_basis"] = (joints, 3, size)
        if self.pose_basis is not None:
            expected["pose_basis"] = (count, 3, 9 * (joints - 1))
        for name, shape in expected.items():
            array = getattr(self, name)
            if array.shape != shape or 0 in shape:
                raise ModelError(f"{name} has shape {array.shape}, expected {shape}, all above 0")
            if not np.isfinite(array).all():
                raise ModelError(f"{name} holds NaN or infinite values")
        if self.faces.min() < 0 or self.faces.max() >= count:
            low, high = self.faces.min(), self.faces.max()
            raise ModelError(f"faces point to vertices {low} ... {high}, expected 0 ... {count - 1}")
        if not (self.parents < np.arange(len(self.parents))).all():
            raise ModelError(f"parents of joints must come before them, got {self.parents.tolist()}")

    def at(self, coefficients: FloatArray, rotations: FloatArray) -> FloatArray:
        """Return the vertices (V, 3) of coefficients (K,) and rotation vectors (J, 3) of the joints [rad]."""
        return self.posed(self.mean + self.basis @ coefficients, coefficients, rotations)[0]

    def posed(
        self, shaped: FloatArray, coefficients: FloatArray, rotations: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return vertices that were `shaped` (V, 3) posed, and their derivatives by shaped and by joints.

        x_i = T_i v_i + sum_k w_ik b_k with T_i = 1 + sum_k w_ik (R_k - 1), R_k the product of the rotations
        from the first ancestor to joint k, b_k = b_p + (R_p - R_k) j_k of the parent p: T (V, 3, 3), and
        (J, 3, K) the derivatives of b_k by c, are returned.
        """
        # The last stands for no parent.
        turn = np.tile(np.eye(3), (len(self.joints) + 1, 1, 1))
        moved = np.zeros((len(self.joints) + 1, 3))
        slopes = np.zeros((len(self.joints) + 1, 3, len(coefficients)))
        local = np.array([rotation_from_vector(vector) for vector in rotations]).reshape(-1, 3, 3)
        for joint, parent in enumerate(self.parents):
            place = self.joint_mean[joint] + self.joint_basis[joint] @ coefficients
            turn[joint] = turn[parent] @ local[joint]
            moved[joint] = moved[parent] + (turn[parent] - turn[joint]) @ place
            slopes[joint] = slopes[parent] + (turn[parent] - turn[joint]) @ self.joint_basis[joint]
        if self.pose_basis is not None:
            shaped = shaped + self.pose_basis @ (local[1:] - np.eye(3)).ravel()
        if not self.joints:
            return shaped, np.broadcast_to(np.eye(3), (len(shaped), 3, 3)), slopes[:-1]
        blend = np.eye(3) + np.tensordot(self.weights, turn[:-1] - np.eye(3), 1)
        return np.einsum("nij,nj->ni", blend, shaped) + self.weights @ moved[:-1], blend, slopes[:-1]

    def of_vertices(self, index: IntArray) -> Self:
        """Return the model of some vertices (N,), with a face that means nothing."""
        return replace(
            self,
            mean=self.mean[index],
            basis=self.basis[index].astype(np.float64),
            weights=self.weights[index],
            pose_basis=None if self.pose_basis is None else self.pose_basis[index],
            faces=np.zeros((1, 3), np.int64),
            uv=None,
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a model, whatever its layout; raises `ModelError`, naming the file, for anything else.

        `MissingDependencyError` where HDF5 needs h5py. A pickle is read as inert data: numpy and scipy arrays
        and the values of chumpy; any other name in it is refused, and no code of the file or of those runs.
        """
        file = Path(path)
        try:
            limits.require_file(file, 4 * limits.FILE_BYTES)
            reader = _READERS.get(file.suffix.lower())
            if reader is None:
                raise ModelError(f"ends in {file.suffix!r}, expected {', '.join(_READERS)}")
            return cls(name=file.stem, sha256=file_sha256(file), **_of_layout(reader(file)))
        except (ModelError, ScanError, MatReadError, pickle.UnpicklingError, *limits.DAMAGE) as error:
            said = f"linear model {file}: {one_line(error).removeprefix(f'linear model {file} ')}"
            raise ModelError(said if _ADVICE in said else f"{said}; {_ADVICE}") from error


def _of_layout(values: Values) -> Values:
    """Return the fields of a model from the arrays of any layout, by their names in it."""
    if "v_template" in values:  # FLAME
        names = {"mean": "v_template", "basis": "shapedirs", "faces": "f", "uv": "vt", "uv_faces": "ft"}
        names |= {"skinning_weights": "weights", "joint_regressor": "J_regressor", "pose_basis": "posedirs"}
        found = {own: values[other] for own, other in names.items() if values.get(other) is not None}
        if "kintree_table" in values:
            parents = np.asarray(values["kintree_table"])[0].astype(np.int64)
            found["joint_parents"] = np.where(parents < len(parents), parents, -1)
            found["joints"] = FLAME_JOINTS if len(parents) == len(FLAME_JOINTS) else range(len(parents))
        shapes: int | None = FLAME_SHAPES
    elif "shapeMU" in values:  # Basel 2009; its shapeEV are standard deviations
        found = {own: values[name] for own, name in (("mean", "shapeMU"), ("basis", "shapePC"))}
        found |= {"deviation": values["shapeEV"], "faces": np.asarray(values["tl"]).astype(np.int64) - 1}
        shapes = None
    elif "shape/model/mean" in values:  # Basel 2017, 2019: Statismo
        found = {"faces": np.asarray(values["shape/representer/cells"]).T}
        for own, part in zip(("", "expression_"), _LISTS, strict=True):
            if f"{part}pcaBasis" in values:
                found[f"{own}basis"] = values[f"{part}pcaBasis"]
                found[f"{own}deviation"] = np.sqrt(values[f"{part}pcaVariance"])
        # The mean face has the mean expression.
        found["mean"] = sum(np.ravel(values[f"{part}mean"]) for part in _LISTS if f"{part}mean" in values)
        shapes = None
    else:  # our own; `MorphableShapeModel` has (K, V, 3), of unit variance
        found, shapes = dict(values), None
        if "identity_basis" in found:
            for own, name in (("basis", "identity_basis"), ("expression_basis",) * 2):
                found[own] = np.moveaxis(np.asarray(found[name]), 0, -1)
    for name in ("mean", "basis", "faces"):
        if name not in found:
            raise ModelError(f"has no {name}, nor what other layouts call it")
    mean = _floats(found, "mean").reshape(-1, 3)
    parts = []
    for name in ("", "expression_"):
        if f"{name}basis" not in found:
            continue
        directions = _floats(found, f"{name}basis")
        if directions.size % mean.size or directions.shape[0] not in (mean.size, len(mean)):
            raise ModelError(
                f"{name}basis has shape {directions.shape}, expected ({len(mean)}, 3, K) as the mean"
            )
        directions = directions.reshape(*mean.shape, -1)
        deviation = _floats(found, f"{name}deviation").ravel() if f"{name}deviation" in found else None
        if deviation is not None and not (deviation.shape == directions.shape[2:] and (deviation >= 0).all()):
            raise ModelError(
                f"{name}deviation has shape {deviation.shape}, expected {directions.shape[2:]}, 0 or more"
            )
        parts.append((directions if deviation is None else directions * deviation).astype(np.float32))
    fields: Values = {"mean": mean, "basis": np.concatenate(parts, axis=2)}
    fields["shapes"] = min(parts[0].shape[2], shapes or parts[0].shape[2])
    faces = fields["faces"] = _indices(found, "faces")
    if "uv" in found:
        fields["uv"] = uv = _floats(found, "uv")
        if uv.ndim == 2:
            corners = _indices(found, "uv_faces") if "uv_faces" in found else faces
            if corners.min() < 0 or corners.max() >= len(uv):
                raise ModelError(f"uv_faces, or faces, point beyond the {len(uv)} uv")
            fields["uv"] = uv[corners]
    if "joints" in found:
        joints = fields["joints"] = tuple(str(name) for name in found["joints"])
        fields["parents"] = np.ravel(found.get("joint_parents", np.full(len(joints), -1))).astype(np.int64)
        fields["weights"] = _floats(found, "skinning_weights")
        if "joint_regressor" in found:
            regressor = _floats(found, "joint_regressor")
            if regressor.shape != (len(joints), len(mean)):
                said = f"expected {(len(joints), len(mean))}"
                raise ModelError(f"joint_regressor has shape {regressor.shape}, {said}")
            fields["joint_mean"] = regressor @ mean
            fields["joint_basis"] = np.tensordot(regressor, fields["basis"], 1)
        else:
            fields["joint_mean"] = _floats(found, "joint_positions")
            fields["joint_basis"] = np.zeros((len(joints), 3, fields["basis"].shape[2]))
        fields["pose_basis"] = _floats(found, "pose_basis") if "pose_basis" in found else None
    return fields


def _floats(values: Mapping[str, Any], name: str) -> FloatArray:
    if name not in values:
        raise ModelError(f"has no {name}")
    array = np.asarray(values[name])
    if array.dtype.kind not in "fiu":
        raise ModelError(f"{name} holds {array.dtype}, expected numbers")
    return array.astype(np.float64)


def _indices(values: Mapping[str, Any], name: str) -> IntArray:
    array = _floats(values, name)
    if array.ndim != 2 or array.shape[1] != 3 or not np.array_equal(array, np.floor(array)) or not len(array):
        raise ModelError(f"{name} has shape {array.shape} of {array.dtype}, expected whole numbers (F, 3)")
    return array.astype(np.int64)


def _read_npz(file: Path) -> Values:
    return read_npz(file, (), optional=_NAMES, what="linear model", advice=_ADVICE, error=ModelError)


def _read_hdf5(file: Path) -> Values:
    with needs_extra("hdf5"):
        import h5py
    with h5py.File(file, "r") as stored:
        return {name: stored[name].asstr()[()] if name == "joints" else stored[name][()]
                for name in _NAMES if name in stored}  # fmt: skip


def _read_matlab(file: Path) -> Values:
    return dict(loadmat(file, variable_names=_NAMES))


def _read_eos(file: Path) -> Values:
    """Read the shape model of an eos file: a cereal archive of MorphableModel, version 1 and later.

    uint32 version; then mean, one or two bases (scaled, orthonormal), eigenvalues, each as int32 rows, int32
    columns and column-major float32; then uint64 count and int32 triples of vertices.
    """
    data, begin, matrices = file.read_bytes(), 4, list[NDArray[np.float32]]()
    while not matrices or matrices[-1].shape[0] == matrices[0].shape[0]:
        rows, columns = np.frombuffer(data, "<i4", 2, begin).tolist()
        if min(rows, columns) < 1 or len(matrices) > 3:
            raise ModelError("is no eos model: it holds no shape, or was written by eos before version 0.12")
        matrices.append(
            np.frombuffer(data, "<f4", rows * columns, begin + 8).reshape((rows, columns), order="F")
        )
        begin += 8 + 4 * rows * columns
    count = int(np.frombuffer(data, "<u8", 1, begin)[0])
    faces = np.frombuffer(data, "<i4", 3 * count, begin + 8).reshape(-1, 3)
    mean, *bases, variance = matrices
    deviation = np.sqrt(variance) if len(bases) == 1 else np.ones_like(variance)
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

    def value(self) -> Any:
        """Return the array that it stands for; raises ModelError where it is none."""
        name = type(self).__name__
        if name == "_reconstructor":  # of (class, base, state of the base)
            name = self.arguments[0].__name__
        if name in ("ndarray", "_reconstruct"):
            _, shape, dtype, fortran, raw = self.state
            return _array(raw, dtype, shape, "F" if fortran else "C")
        if name == "_frombuffer":
            return _array(*self.arguments)
        if name == "Ch":
            return _plain(self.state["x"])
        if name[:4] in ("csc_", "csr_"):
            parts = tuple(_plain(self.state[part]) for part in ("data", "indices", "indptr"))
            shape = self.state.get("_shape", self.state.get("shape"))
            kind = sparse.csc_matrix if name[:4] == "csc_" else sparse.csr_matrix
            return kind(parts, shape).toarray()
        raise ModelError(f"holds a {name} where an array is expected")


_ARRAYS = "ndarray", "dtype", "_reconstruct", "scalar", "_frombuffer", "csc_matrix", "csr_matrix", "csc_array"
_INERT = (*_ARRAYS, "csr_array", "Ch", "_reconstructor", "object", "set")
_HOMES = ("numpy", "scipy", "chumpy", "copy_reg", "copyreg", "__builtin__", "builtins")
_CLASSES = {name: type(name, (_Inert,), {}) for name in _INERT}


class _Unpickler(pickle._Unpickler):
    """Reads a pickle whose only objects are inert. In Python: a hostile memo index makes C's fill memory."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a global; `UnpicklingError` for names that are no array's."""
        if name in _CLASSES and module.partition(".")[0] in _HOMES:
            return _CLASSES[name]
        if (module, name) == ("_codecs", "encode"):  # bytes, as protocol 2 writes them
            return lambda text, _: text.encode("latin1")
        raise pickle.UnpicklingError(
            f"the pickle asks for {module}.{name}, but only arrays of numpy, scipy and chumpy are read, and "
            "nothing of it was run: save the model's arrays as .npz"
        )


def _array(raw: Any, dtype: Any, shape: Any, order: str) -> NDArray[Any]:
    kind = np.dtype(dtype.arguments[0])
    if kind.kind not in "fiub":
        raise ModelError(f"holds an array of {kind}, expected numbers")
    if dtype.state is not None and dtype.state[1] in "<>":
        kind = kind.newbyteorder(dtype.state[1])
    data = raw.encode("latin1") if isinstance(raw, str) else bytes(raw)
    return np.frombuffer(data, kind).reshape(shape, order=order)  # type: ignore[call-overload]


def _plain(value: Any) -> Any:
    return value.value() if isinstance(value, _Inert) else value


def _read_pickle(file: Path) -> Values:
    with file.open("rb") as opened:
        found = _Unpickler(opened, encoding="latin1").load()
    if not isinstance(found, dict):
        raise ModelError(f"the pickle holds a {type(found).__name__}, expected a dict of arrays")
    return {name: _plain(found[name]) for name in _NAMES if name in found}


_READERS = {".npz": _read_npz, ".h5": _read_hdf5, ".hdf5": _read_hdf5, ".mat": _read_matlab}
_READERS |= {".pkl": _read_pickle, ".bin": _read_eos}
