"""Find the axes, regions and landmarks of anyone's face template, with the default model.

The default model is registered and fitted to the template as to a scan, and its annotation carried over. This
needs the stages, so the module stands above `face_model`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.errors import RegistrationError
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.face_model.annotation import LANDMARK_LEVELS, MOUTH_REGION, AnnotatedSurface
from scan2albedo.face_model.from_mesh import FILLED_REGION, DenseTemplate, model_from_surface
from scan2albedo.face_model.limit_fit import project
from scan2albedo.face_model.template_surface import TemplateSurface
from scan2albedo.fitting import fit
from scan2albedo.geometry.closest_points import ClosestPointQuery
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
    kept, faces = without_unreferenced(surface.vertices, surface.faces)
    scan, default = RawScan(surface.vertices[kept], faces, name=given.name), AnnotatedFaceModel.default()
    try:
        pose = register(scan, default)
        fault = f"a face is recognised with confidence {pose.confidence:.2f} only"
        found = fit(scan, default, pose) if pose.confidence >= MIN_CONFIDENCE else None
    except RegistrationError as error:
        found, fault = None, str(error)
    if found is None:
        model = model_from_surface(surface, given, control_size)
        return replace(model, notes=(*model.notes, f"axes taken as they are, nothing annotated: {fault}"))
    rotation, note = found.model_from_scan[:3, :3], "axes as they came"
    degrees = np.degrees(rotation_angle_rad(rotation))
    if degrees <= SAME_AXES_DEG:
        rotation = np.eye(3)
    else:
        note = f"turned by {degrees:.0f} degrees to x left, y up, z out of the face"
    model = model_from_surface(surface.turned(rotation), given, control_size)
    notes, default = [*model.notes, note], found.model
    # The skin of the fitted default model in the new model's frame.
    moved = compose(rotation, np.zeros(3)) @ invert_rigid(found.model_from_scan)
    skin = found.region != default.regions[MOUTH_REGION].index
    vertices, skin_faces = transform_points(moved, found.vertices), found.faces[skin]
    query = ClosestPointQuery(vertices, skin_faces)
    if given.regions is None:
        # Each control face gets the region that lies on it; faces that close the mouth's own hole are film.
        first = 1 + max(region.index for region in model.regions.values())
        added = {
            name: replace(region, index=first + region.index) for name, region in default.regions.items()
        }
        normals = face_normals(model.control_vertices, model.control_faces)
        hits = query.query_facing(model.control_vertices[model.control_faces].mean(1), normals)
        carried = (first + found.region[skin][hits.face]).astype(np.uint8)
        filled = model.regions.get(FILLED_REGION)
        region = np.where(hits.distance > REACH_MM, model.region, carried)
        if filled:
            in_mouth = (model.region == filled.index) & np.isin(carried, [added[lip].index for lip in LIPS])
            region = np.where(in_mouth, added[MOUTH_REGION].index, region)
        model = replace(model, region=region.astype(np.uint8), regions={**model.regions, **added})
        notes.append("regions carried over from the default model")
        if not model.in_region(MOUTH_REGION).any():
            notes.append("no opening between the lips: a mouth that opens stretches what is there")
    if given.landmarks is None:
        assert found.landmarks is not None  # the default model has them
        landmarks = transform_points(moved, found.landmarks)
        normals = face_normals(vertices, skin_faces)[query.query(landmarks).face]
        subdivision = model.subdivision(LANDMARK_LEVELS)
        points = project(subdivision, model.control_vertices, landmarks, normals)
        placed = subdivision.points_matrix(points) @ model.control_vertices
        farthest = float(np.linalg.norm(placed - landmarks, axis=1)[INNER].max())
        if farthest > REACH_MM:
            notes.append(f"no landmarks: one would lie {farthest:.1f} mm beside the template")
        else:
            model = replace(model, landmark_points=points)
            notes.append("landmarks carried over from the default model")
    return replace(model, notes=tuple(notes))
