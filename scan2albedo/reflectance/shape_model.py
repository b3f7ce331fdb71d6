"""`MorphableShapeModel`: faces' shapes as a mean and directions of identity and expression."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import ConfigDict, Field

from scan2albedo.core.arrays import ArrayLike, FloatArray, IntArray, checked_array, checked_mesh
from scan2albedo.errors import ReflectanceError, errors_of
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.io.records import Count, PositiveCount, Record
from scan2albedo.reflectance.vertex_reflectance import require_one_topology
from scan2albedo.statistics.linear_model import LinearModel, principal_directions

LANDMARKS = 68
"""In iBUG-68 order."""
_KINDS = dict.fromkeys(("mean", "identity_basis", "expression_basis"), "f") | dict.fromkeys(
    ("faces", "landmark_vertices"), "iu"
)
"""Of the arrays in a file."""


class ShapeModelHeader(Record):
    """The text "header" in a file of a morphable shape model, as JSON.

    The file also holds mean (V, 3), identity_basis (N_S, V, 3) and expression_basis (N_E, V, 3) in mm,
    faces (F, 3) and landmark_vertices (68,).
    """

    model_config = ConfigDict(title="scan2albedo morphable shape model")

    format: Literal["scan2albedo shape model"] = "scan2albedo shape model"
    format_version: Literal[1] = 1
    vertices: PositiveCount = Field(description="V.")
    identity_components: Count = Field(description="N_S.")
    expression_components: Count = Field(description="N_E.")


@dataclass(frozen=True, eq=False)
class MorphableShapeModel(LinearModel):
    """Shape x = mean + sum a_i identity_i + sum b_i expression_i, coefficients of unit variance.

    `mean` is (V, 3) in mm, `basis` (N_S + N_E, V, 3) with the directions of identity first; those of
    expression begin at the neutral face. After Blanz, Vetter, "A Morphable Model for the Synthesis of 3D
    Faces", SIGGRAPH 1999. Raises `ReflectanceError` when shapes disagree, a number is not finite, or an index
    points outside the vertices.
    """

    error = ReflectanceError

    identity_components: int
    """N_S."""
    faces: IntArray
    """(F, 3): counter-clockwise seen from outside."""
    landmark_vertices: IntArray
    """(68,): vertex of each landmark, iBUG-68 order."""

    def __post_init__(self) -> None:
        count, marks = len(self.mean), self.landmark_vertices
        self.require_shape("shape model:", (count, 3))
        checked_mesh(self.mean, self.faces, "shape model", ReflectanceError)
        if not len(self.faces):
            raise ReflectanceError("shape model: it has no faces")
        checked_array(marks, (LANDMARKS,), "shape model: landmark_vertices", ReflectanceError, kind=int)
        if marks.min() < 0 or marks.max() >= count:
            said = f"landmark_vertices are {marks.min()} to {marks.max()}, it has {count} vertices"
            raise ReflectanceError(f"shape model: {said}")

    @classmethod
    def from_samples(
        cls,
        neutral_vertices: ArrayLike,
        expression_offsets: ArrayLike | None,
        faces: ArrayLike,
        landmark_vertices: ArrayLike,
    ) -> Self:
        """Learn a model from shapes of one topology, rigidly aligned to each other.

        The directions are the principal ones, 80 and 64 at most, of the neutral faces' deviations from their
        mean, and of the expressions' offsets, where an offset and its opposite count as equally likely.
        Raises `ReflectanceError` when there is no face, topologies differ, or numbers are not finite.

        Parameters
        ----------
        neutral_vertices : (K, V, 3) array_like of float
            Millimetres; one or more. One gives a model without directions of identity.
        expression_offsets : (E, V, 3) array_like of float, optional
            Expressive minus neutral face of the same person.
        faces, landmark_vertices : (F, 3), (68,) array_like of int
        """
        neutral = _checked_stack(neutral_vertices, "neutral_vertices")
        if len(neutral) == 0:
            raise ReflectanceError("there is no face to learn shapes from; give one or more")
        count = neutral.shape[1]
        mean = neutral.mean(0)
        basis, _ = principal_directions(neutral - mean, 80, size=np.sum(neutral**2))
        people = len(basis)
        offsets = np.zeros((0, count, 3))
        if expression_offsets is not None:
            offsets = _checked_stack(expression_offsets, "expression_offsets")
        if len(offsets):
            require_one_topology("expression_offsets", offsets.shape[1], "neutral_vertices", count)
            both = np.concatenate([offsets, -offsets])
            expression, _ = principal_directions(both, 64, size=np.sum(both**2))
            basis = np.concatenate([basis, expression])
        return cls(
            mean,
            basis,
            people,
            np.asarray(faces, int),
            checked_array(landmark_vertices, ("L",), "landmark_vertices", ReflectanceError, kind=int),
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a model that `save` wrote; raises `ReflectanceError`, naming the file, for anything else."""
        header, arrays = read_npz_record(
            path,
            ShapeModelHeader,
            _KINDS,
            what="shape model",
            advice="give a file that MorphableShapeModel.save wrote (data_schemas/shape_model.schema.json)",
            error=ReflectanceError,
        )
        shape, indices = (header.vertices, 3), (arrays["faces"], arrays["landmark_vertices"])
        counts = (), (header.identity_components,), (header.expression_components,)
        with errors_of(f"shape model {path}", ReflectanceError, advice="write the file again"):
            mean, *bases = (
                checked_array(arrays[name], (*count, *shape), name, ReflectanceError)
                for name, count in zip(_KINDS, counts, strict=False)
            )
            return cls(mean, np.concatenate(bases), header.identity_components, *indices)

    def save(self, path: str | Path) -> None:
        """Write the model as an .npz file, whole or not at all; same model, same bytes.

        Raises `ValueError` when the name does not end in .npz, `OutputError` when it cannot be written.
        """
        header = ShapeModelHeader(
            vertices=len(self.mean),
            identity_components=self.identity_components,
            expression_components=self.expression_components,
        )
        identity, expression = np.split(self.basis, [self.identity_components])
        values = self.mean, identity, expression, self.faces, self.landmark_vertices
        write_npz_record(path, header, dict(zip(_KINDS, values, strict=True)), what="shape model")

    @property
    def expression_components(self) -> int:
        """N_E."""
        return self.components - self.identity_components


def _checked_stack(shapes: ArrayLike, name: str) -> FloatArray:
    try:
        stack = np.asarray(shapes, float)
    except ValueError as error:
        raise ReflectanceError(f"{name} differ in number of vertices; bring all to one topology") from error
    checked_array(stack, ("K", "V", 3), name, ReflectanceError)
    bad = ~np.isfinite(stack).all((1, 2))
    if bad.any():
        raise ReflectanceError(f"{name}: shape {np.flatnonzero(bad)[0]} is not finite; leave it out")
    return stack
