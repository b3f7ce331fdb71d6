"""Processed faces of which a part was not seen, or looks otherwise; a model with a template of its own."""

from dataclasses import replace

import numpy as np

from scan2albedo import AnnotatedFaceModel
from scan2albedo.geometry.loop_subdivision import SurfacePoints


def square(face, rows, columns):
    """Return the texels (H, W) in these rows and columns, each first and last + 1."""
    texels = np.zeros(face.mask.shape, bool)
    texels[slice(*rows), slice(*columns)] = True
    return texels


def painted(face, texels, color):
    """Return a face with another albedo, of any shape that broadcasts, at some texels (H, W)."""
    return replace(face, albedo_linear=np.where(texels[..., None], color, face.albedo_linear))


def unseen(face, texels):
    """Return a face of which the scan does not show some texels (H, W)."""
    return replace(face, image=replace(face.image, texture_valid=face.mask & ~texels))


def with_template(columns=1):
    """Return the default model with its control mesh as template, charted on so many tiles side by side."""
    model = AnnotatedFaceModel.default()
    face, corner = np.zeros((2, len(model.control_vertices)), np.int64)
    for number, triangle in enumerate(model.control_faces):
        face[triangle], corner[triangle] = number, np.arange(3)
    return replace(
        model,
        template_points=SurfacePoints(face, np.eye(3)[corner]),
        template_faces=model.control_faces,
        template_uv=model.uv[model.control_faces] * [columns, 1],
        name="mine",
    )
