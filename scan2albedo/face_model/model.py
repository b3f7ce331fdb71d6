"""The Annotated Face Model: the default one, anyone's template, and files of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Self

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.hooks import TEMPLATE_ANNOTATOR
from scan2albedo.errors import ModelError, ScanError
from scan2albedo.face_model.annotation import AnnotatedSurface
from scan2albedo.face_model.files import load_model, save_model
from scan2albedo.face_model.from_mesh import DenseTemplate, model_from_surface
from scan2albedo.face_model.template_surface import template_surface
from scan2albedo.io.load_scan import SUPPORTED_SCANS, read_mesh_file


@dataclass(frozen=True)
class AnnotatedFaceModel(AnnotatedSurface):
    """A face template whose surface is the Loop limit surface of a control mesh; see `AnnotatedSurface`."""

    @staticmethod
    @lru_cache(maxsize=1)
    def default() -> AnnotatedFaceModel:
        """Return the model that ships with the package (cached)."""
        return AnnotatedFaceModel.load(str(files("scan2albedo.face_model") / "data" / "afm.json"))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a model from its JSON file."""
        return cls._with_fields_of(load_model(path))

    def save(self, path: str | Path) -> None:
        """Write the model as JSON beside a small binary of its arrays."""
        save_model(self, path)

    @classmethod
    def from_mesh(
        cls,
        vertices: FloatArray,
        faces: IntArray,
        uv: FloatArray | None = None,
        regions: Mapping[str, IntArray] | None = None,
        landmarks: FloatArray | IntArray | None = None,
        *,
        control_size: int = 1000,
        annotate: bool = True,
        name: str = "template",
    ) -> Self:
        """Return an `AnnotatedFaceModel` made from a dense face template of 100 to 100,000 vertices.

        The template is mended (unit, seams, loose parts, a few faces that spoil the surface, holes for eyes
        and mouth) and turned into the model's axes, its edges are collapsed to about `control_size` vertices,
        and these are moved until the Loop limit surface passes near the template. Every template vertex is
        placed on that surface, so that a fit returns the face in the template's own topology. Regions and
        landmarks that are not given are carried over from the default model, registered and fitted to the
        template.

        The model is in millimetres, its origin at the centroid of the template's vertices in faces; the
        template's own axes stay where they are within 25 degrees of the convention's. Raises ModelError when
        the template, the regions or the landmarks cannot be used; the message says why.

        Parameters
        ----------
        vertices : (T, 3) array of float
            Micrometres, millimetres, centimetres or metres (decided by the size of a head); any axes when
            `annotate`, else +x the subject's left, +y up, +z out of the face.
        faces : (F, 3) array of int
            Triangles. Vertices without a face, or on loose parts (eyeballs), are carried along by the
            nearest surface.
        uv : (T, 2) or (F, 3, 2) array of float, optional
            Texture coordinates of vertices, or of faces' corners: what `template_texture` paints. Where each
            vertex has one place they are the chart too; a new one is drawn when there are seams, when it
            folds over, or when uv is omitted.
        regions : mapping of str to array, optional
            Vertex indices, or a bool mask of T vertices or F faces, by name. The rest is region "face",
            faces that close a hole are region "filled"; these two names are reserved. Scans exert no force on
            a region named "between_lips", to which `annotate` assigns the faces that close the mouth.
        landmarks : (68, 3) array of float or (68,) array of int, optional
            Points in the template's frame and unit, or vertex indices, iBUG-68 order.
        control_size : int
            Control vertices aimed at; a template not much larger keeps its own vertices. A template of the
            whole head spends most of them beside the face: 2500 correspond to 1000 for a face.
        annotate : bool
            Find the template's axes, and what annotation is not given, with the default model. Where no
            face is recognised in the template, its axes are taken as they are and `notes` says so.
        name : str
            Used in messages and results.
        """
        given = DenseTemplate(vertices, faces, uv, regions, landmarks, name)
        surface = template_surface(vertices, faces, name)
        # Annotating registers and fits the default model: the stages, floors above this one, provide it.
        make = TEMPLATE_ANNOTATOR.provided() if annotate else model_from_surface
        return cls._with_fields_of(make(surface, given, control_size))

    @classmethod
    def from_file(cls, path: str | Path, *, control_size: int = 1000) -> Self:
        """Make a model out of a template in an OBJ, PLY, GLB, glTF, STL or OFF file.

        `control_size` is that of `from_mesh`. The vertices keep the file's order. The chart is the file's
        where every vertex has one texture coordinate, else a new one. Raises `ModelError` when the file
        cannot be read, or `from_mesh` cannot use the template.
        """
        file = Path(path)
        try:
            parsed = read_mesh_file(file)
        except ScanError as error:
            raise ModelError(f"template {error}") from error
        return cls.from_mesh(
            parsed.vertices, parsed.faces, parsed.uv, control_size=control_size, name=file.stem
        )

    @classmethod
    def _with_fields_of(cls, surface: AnnotatedSurface) -> Self:
        return cls(**{field.name: getattr(surface, field.name) for field in fields(surface)})


def chosen_model(model: AnnotatedFaceModel | str | Path | None) -> AnnotatedFaceModel | None:
    """Return the model of a user's choice; None for "none".

    Parameters
    ----------
    model : AnnotatedFaceModel, str, Path or None
        A model, the file of a model or of a template, "default" (also None) or "none".

    Raises
    ------
    ModelError
        When there is no such file, or it holds neither.
    """
    if isinstance(model, AnnotatedFaceModel):
        return model
    if model is None or str(model) == "default":
        return AnnotatedFaceModel.default()
    if str(model) == "none":
        return None
    if not Path(model).is_file():
        raise ModelError(
            f"{model}: no such file; give a model's JSON file, a template's mesh, 'default' or 'none'"
        )
    if Path(model).suffix.lower() in SUPPORTED_SCANS:
        return AnnotatedFaceModel.from_file(model)
    return AnnotatedFaceModel.load(model)
