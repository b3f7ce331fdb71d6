"""Whether faces share one chart, so that a texel of one is the same place of the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2albedo.applications.processed_face import NO_MODEL, FaceMesh, ProcessedFace
from scan2albedo.errors import ApplicationError

_SAME_UV = 1e-5
"""Chart coordinates closer than this are the same: GLB files hold them with 24 bits."""
_LEAST_OVERLAP = 0.9
"""Part of the smaller mask that has to lie in the other for two charts to be the same."""


def on_common_chart(*faces: ProcessedFace) -> tuple[ProcessedFace, ...]:
    """Return the faces on the texels that all of them have.

    Raises
    ------
    ApplicationError
        When sizes, models, meshes or charts differ, or a face has a chart of its own; the message names both
        faces and what differs.
    """
    first = faces[0]
    for other in faces[1:]:
        _check_pair(first, other)
    mask = np.logical_and.reduce([face.mask for face in faces])
    return tuple(_restricted(face, mask) for face in faces)


def _check_pair(a: ProcessedFace, b: ProcessedFace) -> None:
    both = f"{a.name} and {b.name}"
    if a.image.shape != b.image.shape:
        raise ApplicationError(
            f"{both}: geometry images of {_size(a)} and {_size(b)} texels; process both scans with one --size"
        )
    if a.model_name != b.model_name:
        raise ApplicationError(
            f"{both}: processed with different models, {a.model_name!r} and {b.model_name!r}; "
            "process both scans with one --model"
        )
    if same_mesh(a.mesh, b.mesh):
        return
    if a.model_name == NO_MODEL:
        raise ApplicationError(
            f"{both}: processed without a model, so each has its own chart and texels do not correspond; "
            "process both scans with a model"
        )
    overlap = (a.mask & b.mask).sum() / min(a.mask.sum(), b.mask.sum())
    if not (a.mesh.from_chart and b.mesh.from_chart and overlap >= _LEAST_OVERLAP):
        raise ApplicationError(
            f"{both}: their charts differ although both name the model {a.model_name!r}; "
            "process both scans again with one version of it"
        )


def same_mesh(a: FaceMesh, b: FaceMesh) -> bool:
    """Return whether two meshes have the same triangles at the same places of the chart."""
    same = len(a.uv) == len(b.uv) and np.array_equal(a.faces, b.faces)
    return bool(same and np.allclose(a.uv, b.uv, rtol=0, atol=_SAME_UV))


def _restricted(face: ProcessedFace, mask: np.ndarray) -> ProcessedFace:
    if np.array_equal(face.mask, mask):
        return face
    old = face.image
    image = replace(
        old,
        mask=mask,
        position=np.where(mask[..., None], old.position, 0),
        normal=np.where(mask[..., None], old.normal, 0),
        region=None if old.region is None else np.where(mask, old.region, 255),
    )
    return replace(face, image=image, mesh=FaceMesh.of_chart(image))


def _size(face: ProcessedFace) -> str:
    return f"{face.image.shape[1]} x {face.image.shape[0]}"
