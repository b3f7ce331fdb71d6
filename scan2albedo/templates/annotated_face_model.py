"""The Annotated Face Model: the default one, anyone's template, and files of both.

A template gets its axes, regions and landmarks from the default model, which is registered and fitted to it
as to a scan. This needs the stages, so the public class stands above them; what they work on is its base.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray, IntArray, norms
from scan2albedo.errors import ModelError, RegistrationError, ScanError, errors_of
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.face_model.annotation import FILLED_REGION, LANDMARK_LEVELS, MOUTH_REGION
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.geometry.mesh import boundary_vertex_mask, face_normals, vertex_normals, without_unreferenced
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_angle_rad, transform_points
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.io.load_scan import SUPPORTED_SCANS, read_mesh_file
from scan2albedo.templates.from_mesh import DenseTemplate, model_from_surface, project
from scan2albedo.templates.surface import TemplateSurface, template_surface

if TYPE_CHECKING:
    from scan2albedo.fitting import FittedFace

_REACH_MM = 8.0
"""Annotation that lies farther from the template than this is not carried over."""
_LIPS = ("upper_lip", "lower_lip")


@dataclass(frozen=True)
class AnnotatedFaceModel(AnnotatedSurface):
    """A face template whose surface is the Loop limit surface of a control mesh; see `AnnotatedSurface`."""

    @staticmethod
    @lru_cache(maxsize=1)
    def default() -> AnnotatedFaceModel:
        """Return the model that ships with the package (cached)."""
        return AnnotatedFaceModel._with_fields_of(default_model())

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

        The template is mended and turned into the model's axes, its edges are collapsed to about
        `control_size` vertices, and these are moved until the Loop limit surface passes near the template.
        Every template vertex is placed on that surface, so that a fit returns the face in the template's own
        topology. Regions and landmarks that are not given come from the default model, fitted to it.

        The model is in millimetres, its origin at the centroid of the template's vertices in faces; axes
        within 25 degrees of the convention's stay. Raises ModelError for what cannot be used.

        Parameters
        ----------
        vertices : (T, 3) array of float
            Micrometres, millimetres, centimetres or metres (decided by the size of a head); any axes when
            `annotate`, else +x the subject's left, +y up, +z out of the face.
        faces : (F, 3) array of int
            Triangles. Vertices without a face, or on loose parts (eyeballs), follow the nearest surface.
        uv : (T, 2) or (F, 3, 2) array of float, optional
            Texture coordinates of vertices, or of faces' corners: what `template_texture` paints. Where each
            vertex has one place they are the chart too, unless it folds over; else a new one is drawn.
        regions : mapping of str to array, optional
            Vertex indices, or a bool mask of T vertices or F faces, by name; "face" (the rest) and "filled"
            (faces that close a hole) are reserved. Scans exert no force on a region named "between_lips".
        landmarks : (68, 3) array of float or (68,) array of int, optional
            Points in the template's frame and unit, or vertex indices, iBUG-68 order.
        control_size : int
            Control vertices aimed at; of a whole head 2500 correspond to 1000 for a face.
        annotate : bool
            Find the template's axes, and what annotation is not given, with the default model. Where no
            face is recognised in the template, its axes are taken as they are and `notes` says so.
        name : str
            Used in messages and results.
        """
        template = DenseTemplate(vertices, faces, uv, regions, landmarks, name)
        make = _annotated_model if annotate else model_from_surface
        return cls._with_fields_of(make(template_surface(vertices, faces, name), template, control_size))

    @classmethod
    def from_file(cls, path: str | Path, *, control_size: int = 1000) -> Self:
        """Make a model of about `control_size` out of a template in an OBJ, PLY, GLB, glTF, STL or OFF file.

        The vertices keep the file's order. Raises `ModelError` when the file or the template cannot be used.
        """
        file = Path(path)
        try:
            mesh = read_mesh_file(file)
        except ScanError as error:
            raise ModelError(f"template {error}") from error
        return cls.from_mesh(mesh.vertices, mesh.faces, mesh.uv, control_size=control_size, name=file.stem)

    @classmethod
    def _with_fields_of(cls, surface: AnnotatedSurface) -> Self:
        return cls(**{field.name: getattr(surface, field.name) for field in fields(surface)})


def chosen_model(model: AnnotatedFaceModel | str | Path | None) -> AnnotatedFaceModel | None:
    """Return the model of a user's choice; None for "none".

    That is a model, the file of a model or of a template, "default" (also None) or "none". Raises ModelError
    when there is no such file, or it holds neither.
    """
    if isinstance(model, AnnotatedFaceModel):
        return model
    if model is None or str(model) == "default":
        return AnnotatedFaceModel.default()
    if str(model) == "none":
        return None
    if not Path(model).is_file():
        raise ModelError(f"{model}: no such file; give a model's JSON, a template mesh, 'default' or 'none'")
    if Path(model).suffix.lower() in SUPPORTED_SCANS:
        return AnnotatedFaceModel.from_file(model)
    return AnnotatedFaceModel.load(model)


def fitted_to_template(surface: TemplateSurface, name: str, model: AnnotatedSurface) -> FittedFace:
    """Return a model fitted to a template as to a scan; RegistrationError where no face is recognised."""
    from scan2albedo.fitting import fit
    from scan2albedo.registration import register

    kept, faces = without_unreferenced(surface.vertices, surface.faces)
    scan = RawScan(surface.vertices[kept], faces, name=name)
    registration = register(scan, model)
    # Below even odds the pose is more likely wrong than right.
    if (chance := registration.confidence) < 0.5:
        raise RegistrationError(f"a face is recognised with confidence {chance:.2f} only")
    return fit(scan, model, registration)


def linear_model_places(
    linear: LinearFaceModel, model: AnnotatedSurface
) -> tuple[LinearFaceModel, SurfacePoints]:
    """Return a linear model with its unit and faces wound outward, and where its mean's vertices (V,) lie on
    an annotated face model, which is fitted to it.

    `face` is -1 off the mean's largest part (eyeballs, teeth), `barycentric` 0 of vertices without a place.
    Raises `ModelError`, naming the linear model, where its mean is no surface or shows no face.
    """
    return _on_default(linear) if model is AnnotatedFaceModel.default() else _places(linear, model)


def _places(linear: LinearFaceModel, model: AnnotatedSurface) -> tuple[LinearFaceModel, SurfacePoints]:
    from scan2albedo.fitting.result import RESIDUAL_GATE_MM

    with errors_of("linear model", ModelError, RegistrationError):
        surface = template_surface(linear.mean, linear.faces, linear.name)
        fitted = fitted_to_template(surface, linear.name, model)
    used = np.unique(surface.faces)
    points = transform_points(fitted.model_from_scan, surface.vertices)
    normals = vertex_normals(points, surface.faces)
    subdivision = fitted.model.subdivision(fitted.levels)
    skin = np.flatnonzero(~fitted.model.in_region(MOUTH_REGION)[subdivision.parent])
    query = ClosestPointQuery(fitted.vertices, fitted.faces[skin])
    hits = query.query_facing(points[used], normals[used])
    rim = boundary_vertex_mask(len(fitted.vertices), fitted.faces[skin])
    inner = hits.interpolated(~rim, fitted.faces[skin]) > 1 / 1000
    places = SurfacePoints(np.full(len(points), -1), np.zeros(points.shape))
    known = inner & (hits.distance < RESIDUAL_GATE_MM)
    places.face[used], places.barycentric[used] = skin[hits.face], hits.barycentric * known[:, None]
    faces, uv = linear.faces, linear.uv
    if np.sum(vertex_normals(points, faces)[used] * normals[used]) < 0:  # wound inward
        faces, uv = faces[:, ::-1], None if uv is None else uv[:, ::-1]
    unit = float(np.linalg.det(surface.template_from_surface[:3, :3]) ** (-1 / 3))
    return replace(linear, faces=faces, uv=uv, mm_per_unit=unit), places


_on_default = lru_cache(maxsize=1)(lambda linear: _places(linear, AnnotatedFaceModel.default()))
"""Kept for the next scan."""


def _annotated_model(
    surface: TemplateSurface, template: DenseTemplate, control_size: int
) -> AnnotatedSurface:
    """Make a model in the convention's axes, with the default model's annotation where none is given.

    `surface` is that of `template`, in any pose; the model gets about `control_size` control vertices.
    """
    default = default_model()
    try:
        fitted = fitted_to_template(surface, template.name, default)
    except RegistrationError as error:
        model = model_from_surface(surface, template, control_size)
        return replace(model, notes=(*model.notes, f"axes taken as they are, nothing annotated: {error}"))
    rotation, axes = fitted.model_from_scan[:3, :3], "axes as they came"
    degrees = np.degrees(rotation_angle_rad(rotation))
    if degrees <= 25:  # templates look up or down by some degrees
        rotation = np.eye(3)
    else:
        axes = f"turned by {degrees:.0f} degrees to x left, y up, z out of the face"
    model = model_from_surface(surface.turned(rotation), template, control_size)
    # The skin of the fitted default model in the new model's frame.
    model_from_default = compose(rotation, np.zeros(3)) @ invert_rigid(fitted.model_from_scan)
    is_skin = fitted.region != default.regions[MOUTH_REGION].index
    skin, skin_faces = transform_points(model_from_default, fitted.vertices), fitted.faces[is_skin]
    nearest = ClosestPointQuery(skin, skin_faces)
    # Each control vertex gets the place on the default chart that lies on it.
    normals = vertex_normals(model.control_vertices, model.control_faces)
    hits = nearest.query_facing(model.control_vertices, normals)
    model = replace(model, face_uv=hits.interpolated(fitted.uv, skin_faces))
    notes = [*model.notes, axes]
    if template.regions is None:
        # Each control face gets the region that lies on it.
        first = 1 + max(region.index for region in model.regions.values())
        added = {name: replace(own, index=first + own.index) for name, own in default.regions.items()}
        centres = model.control_vertices[model.control_faces].mean(1)
        hits = nearest.query_facing(centres, face_normals(model.control_vertices, model.control_faces))
        carried = (first + fitted.region[is_skin][hits.face]).astype(np.uint8)
        region = np.where(hits.distance > _REACH_MM, model.region, carried)
        # Faces that close the mouth's own hole are film.
        in_mouth = model.in_region(FILLED_REGION) & np.isin(carried, [added[name].index for name in _LIPS])
        region = np.where(in_mouth, added[MOUTH_REGION].index, region).astype(np.uint8)
        model = replace(model, region=region, regions={**model.regions, **added})
        notes.append("regions carried over from the default model")
        if not model.in_region(MOUTH_REGION).any():
            notes.append("no opening between the lips: a mouth that opens stretches what is there")
    if template.landmarks is None:
        assert fitted.landmarks is not None  # the default model has them
        landmarks = transform_points(model_from_default, fitted.landmarks)
        normals = face_normals(skin, skin_faces)[nearest.query(landmarks).face]
        subdivision = model.subdivision(LANDMARK_LEVELS)
        points = project(subdivision, model.control_vertices, landmarks, normals)
        apart = subdivision.points_matrix(points) @ model.control_vertices - landmarks
        farthest = float(norms(apart)[17:].max())
        if farthest > _REACH_MM:
            notes.append(f"no landmarks: one would lie {farthest:.1f} mm beside the template")
        else:
            model = replace(model, landmark_points=points)
            notes.append("landmarks carried over from the default model")
    return replace(model, notes=tuple(notes))
