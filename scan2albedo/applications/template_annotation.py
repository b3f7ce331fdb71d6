"""Find the axes, regions and landmarks of anyone's face template, with the default model.

The default model is registered and fitted to the template as to a scan, and its annotation carried over. This
needs the stages, so the module stands above `face_model`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import RegistrationError
from scan2albedo.face_model import AnnotatedFaceModel, Region
from scan2albedo.face_model.annotation import LANDMARK_LEVELS, MOUTH_REGION, AnnotatedSurface
from scan2albedo.face_model.from_mesh import FILLED_REGION, DenseTemplate, model_from_surface
from scan2albedo.face_model.limit_fit import project
from scan2albedo.face_model.template_surface import TemplateSurface
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.geometry.mesh import face_normals, without_unreferenced
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_angle_rad, transform_points
from scan2albedo.registration import register

SAME_AXES_DEG = 25.0
"""Templates look up or down by some degrees; only templates turned further get other axes."""
MIN_CONFIDENCE = 0.5
"""Of the pose of a template's face, below which it is more likely wrong than right."""
REACH_MM = 8.0
"""Annotation that lies farther from the template than this is not carried over."""
INNER = slice(17, 68)
LIPS = ("upper_lip", "lower_lip")


def annotated_model(surface: TemplateSurface, given: DenseTemplate, control_size: int) -> AnnotatedSurface:
    """Make a model in the convention's axes, with the default model's annotation where none is given.

    `surface` is that of `given`, in any pose; the model gets about `control_size` control vertices.
    ModelError when the template, the regions or the landmarks cannot be used; the message says why.
    """
    found = _recognized(surface, given.name)
    if isinstance(found, str):
        model = model_from_surface(surface, given, control_size)
        return replace(model, notes=(*model.notes, f"axes taken as they are, nothing annotated: {found}"))
    rotation, note = _turn(found.model_from_scan[:3, :3])
    model = model_from_surface(surface.turned(rotation), given, control_size)
    source = _FittedDefault.of(found, compose(rotation, np.zeros(3)) @ invert_rigid(found.model_from_scan))
    notes = [*model.notes, note]
    if given.regions is None:
        region, table = _carried_regions(source, model)
        model = replace(model, region=region, regions=table)
        notes.append("regions carried over from the default model")
        if not model.in_region(MOUTH_REGION).any():
            notes.append("no opening between the lips: a mouth that opens stretches what is there")
    if given.landmarks is None:
        points, note = _carried_landmarks(source, model)
        model = replace(model, landmark_points=points)
        notes.append(note)
    return replace(model, notes=tuple(notes))


def _recognized(surface: TemplateSurface, name: str) -> FittedFace | str:
    """Return the default model fitted to the template, or why it could not be."""
    kept, faces = without_unreferenced(surface.vertices, surface.faces)
    scan = RawScan(surface.vertices[kept], faces, name=name)
    default = AnnotatedFaceModel.default()
    try:
        registration = register(scan, default)
    except RegistrationError as error:
        return str(error)
    if registration.confidence < MIN_CONFIDENCE:
        return f"a face is recognised with confidence {registration.confidence:.2f} only"
    return fit(scan, default, registration)


def _turn(rotation: FloatArray) -> tuple[FloatArray, str]:
    degrees = np.degrees(rotation_angle_rad(rotation))
    if degrees <= SAME_AXES_DEG:
        return np.eye(3), "axes as they came"
    return rotation, f"turned by {degrees:.0f} degrees to x left, y up, z out of the face"


@dataclass(frozen=True)
class _FittedDefault:
    """The skin of the fitted default model in the new model's frame: (V, 3) mm, (F, 3), its annotation."""

    vertices: FloatArray
    faces: IntArray
    region: NDArray[np.uint8]
    landmarks: FloatArray
    default: AnnotatedFaceModel

    @classmethod
    def of(cls, fitted: FittedFace, model_from_default: FloatArray) -> _FittedDefault:
        assert fitted.landmarks is not None  # the default model has them
        skin = fitted.region != fitted.model.regions[MOUTH_REGION].index
        return cls(
            transform_points(model_from_default, fitted.vertices),
            fitted.faces[skin],
            fitted.region[skin],
            transform_points(model_from_default, fitted.landmarks),
            fitted.model,
        )


def _carried_regions(
    source: _FittedDefault, model: AnnotatedSurface
) -> tuple[NDArray[np.uint8], dict[str, Region]]:
    """Give each control face the region that lies on it; faces that close the mouth's own hole are film."""
    first = 1 + max(region.index for region in model.regions.values())
    added = {
        name: replace(region, index=first + region.index) for name, region in source.default.regions.items()
    }
    normals = face_normals(model.control_vertices, model.control_faces)
    centres = model.control_vertices[model.control_faces].mean(1)
    hits = ClosestPointQuery(source.vertices, source.faces).query_facing(centres, normals)
    carried = (first + source.region[hits.face]).astype(np.uint8)
    lips = [added[name].index for name in LIPS]
    filled = model.regions.get(FILLED_REGION)
    in_mouth = (model.region == filled.index) & np.isin(carried, lips) if filled else False
    beyond = hits.distance > REACH_MM
    region = np.where(in_mouth, added[MOUTH_REGION].index, np.where(beyond, model.region, carried))
    return region.astype(np.uint8), {**model.regions, **added}


def _carried_landmarks(source: _FittedDefault, model: AnnotatedSurface) -> tuple[SurfacePoints | None, str]:
    """Place the landmarks where they lie on the template; none when an inner one lies beside it."""
    surface = ClosestPointQuery(source.vertices, source.faces).query(source.landmarks)
    normals = face_normals(source.vertices, source.faces)[surface.face]
    subdivision = model.subdivision(LANDMARK_LEVELS)
    points = project(subdivision, model.control_vertices, source.landmarks, normals)
    apart = np.linalg.norm(
        subdivision.points_matrix(points) @ model.control_vertices - source.landmarks, axis=1
    )
    farthest = float(apart[INNER].max())
    if farthest > REACH_MM:
        return None, f"no landmarks: one would lie {farthest:.1f} mm beside the template"
    return points, "landmarks carried over from the default model"
