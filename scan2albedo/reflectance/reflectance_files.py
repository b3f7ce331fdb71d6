"""Reflectance of a mesh's vertices as NPZ files with a header."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import ConfigDict, Field

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, attributes, checked_array, checked_mesh
from scan2albedo.errors import ReflectanceError, errors_of
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.io.records import Count, PositiveCount, Record
from scan2albedo.reflectance.vertex_fit import ReflectanceFit
from scan2albedo.reflectance.vertex_reflectance import (
    EXPONENTS,
    VertexReflectance,
    check_exponents,
    require_one_topology,
)

RESULT_FILE = "reflectance.npz"
"""In the folder that the command `fit` writes."""
_ARRAYS = {"vertices": "f", "faces": "iu", "known": "b", "diffuse_linear": "f", "weights": "f"}
_OF_A_FIT = (
    *("std", "low", "high", "pair_count", "condition", "activation", "identifiability", "identified"),
    *("impossible", "misfit", "tilt", "normal_sigma_degrees", "light_gain"),
)
"""Further arrays in a fit's file; NaN where a vertex is not known."""


@dataclass(frozen=True)
class MeshReflectance:
    """The reflectance of a mesh's vertices; `ReflectanceError` for shapes or faces that do not fit."""

    vertices: FloatArray
    """(V, 3): millimetres."""
    faces: IntArray
    """(F, 3)."""
    reflectance: VertexReflectance
    """Of V vertices."""
    std: FloatArray | None = None
    """(V, 6): standard deviations of albedos and weights where a fit gave them, NaN where not known."""
    seen: BoolArray | None = None
    """(V,): which vertices a photograph shows, where a model gave the others; None where it is not known."""

    def __post_init__(self) -> None:
        vertices, faces = checked_mesh(self.vertices, self.faces, "the mesh", ReflectanceError)
        count = len(self.reflectance.known)
        require_one_topology("the mesh", len(vertices), "its reflectance", count)
        if self.std is not None:
            checked_array(self.std, (count, 6), "std", ReflectanceError)
        if self.seen is not None:
            checked_array(self.seen, (count,), "seen", ReflectanceError, kind=bool)
        vars(self).update(vertices=vertices, faces=faces)


class MeshReflectanceHeader(Record):
    """The text "header" in a file of a mesh's reflectance, as JSON.

    The file also holds vertices (V, 3) in mm, faces (F, 3), known (V,), diffuse_linear and weights (V, 3);
    that of a fit also std, low, high, identifiability and identified (V, 6), pair_count, condition, misfit,
    impossible and normal_sigma_degrees (V,), tilt (V, 2), activation (V, 3) and light_gain (L, 3);
    that of one photograph also seen (V,).
    """

    model_config = ConfigDict(title="scan2albedo reflectance of a mesh")

    format: Literal["scan2albedo mesh reflectance"] = "scan2albedo mesh reflectance"
    format_version: Literal[1] = 1
    exponents: tuple[float, float, float] = Field(description="Of the Blinn-Phong lobes, in their order.")
    vertices: PositiveCount = Field(description="V.")
    faces: Count = Field(description="F.")


def write_reflectance(path: str | Path, mesh: MeshReflectance, *, fit: ReflectanceFit | None = None) -> None:
    """Write a mesh's reflectance as an .npz file, whole or not at all, with the figures of its fit if given.

    Raises `ValueError` when the name does not end in .npz, `OutputError` when the file cannot be written.

    Parameters
    ----------
    path, mesh, fit : path, MeshReflectance, ReflectanceFit
    """
    one = mesh.reflectance
    header = MeshReflectanceHeader(exponents=EXPONENTS, vertices=len(mesh.vertices), faces=len(mesh.faces))
    values = mesh.vertices, mesh.faces, one.known, one.diffuse_linear, one.weights
    arrays = dict(zip(_ARRAYS, values, strict=True))
    if fit is not None:
        arrays |= attributes(fit, *_OF_A_FIT)
    if mesh.seen is not None:
        arrays["seen"] = mesh.seen
    write_npz_record(path, header, arrays, what="reflectance")


def read_reflectance(path: str | Path) -> MeshReflectance:
    """Return a mesh's reflectance from its file at `path`, or from the folder of a fit.

    Raises `ReflectanceError` when the file is missing, damaged or something else; names it.
    """
    if Path(path).is_dir():
        path = Path(path) / RESULT_FILE
    header, arrays = read_npz_record(
        path,
        MeshReflectanceHeader,
        _ARRAYS,
        optional={"std": "f", "seen": "b"},
        what="reflectance",
        advice="give a file that write_reflectance wrote, or a fit's folder",
        error=ReflectanceError,
    )
    check_exponents(header.exponents, f"reflectance {path}")
    with errors_of(f"reflectance {path}", ReflectanceError, advice="write the file again"):
        one = VertexReflectance(arrays["diffuse_linear"], arrays["weights"], arrays["known"])
        more = arrays.get("std"), arrays.get("seen")
        return MeshReflectance(arrays["vertices"], arrays["faces"], one, *more)
