"""Meshes in few bytes for the viewer: 16 bits a number, triangles shared by scans that have the same."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.applications.processed_face import FaceMesh
from scan2albedo.core.geometry_image import GeometryImage

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LEVELS = 65535
MOST_VERTICES = 60_000
"""Of a chart's mesh; finer ones are thinned."""


@dataclass(frozen=True)
class ViewMesh:
    """What the viewer draws: vertices (V, 3) mm, faces (F, 3), uv (V, 2), unit normals (V, 3)."""

    vertices: FloatArray
    faces: IntArray
    uv: FloatArray
    normals: FloatArray

    @classmethod
    def of(cls, mesh: FaceMesh) -> ViewMesh:
        """Return a face's mesh with its normals."""
        return cls(mesh.vertices, mesh.faces, mesh.uv, mesh.normals)


@dataclass
class Topologies:
    """Triangles and charts of a report's meshes, each once: {key: {"faces", "uv", "wide"}}."""

    of_key: dict[str, dict[str, Any]] = field(default_factory=dict)

    def add(self, faces: IntArray, uv: FloatArray) -> str:
        """Keep triangles (F, 3) and chart coordinates (V, 2) and return their key."""
        wide = len(uv) > _LEVELS
        index = np.ascontiguousarray(faces, "<u4" if wide else "<u2").tobytes()
        chart = quantized(np.clip(uv, 0, 1), np.zeros(2), np.ones(2)).tobytes()
        key = hashlib.sha256(index + chart).hexdigest()[:12]
        self.of_key[key] = {"faces": encoded(index), "uv": encoded(chart), "wide": wide}
        return key


def encoded(data: bytes) -> str:
    """Return bytes as base64 text."""
    return base64.b64encode(data).decode("ascii")


def quantized(values: FloatArray, low: FloatArray, span: FloatArray) -> NDArray[np.uint16]:
    """Return values between `low` and `low + span` as little-endian 16-bit parts of the span."""
    parts = (values - low) / np.where(span > 0, span, 1.0)
    return np.round(np.clip(parts, 0, 1) * _LEVELS).astype("<u2")


def octahedral(normals: FloatArray) -> NDArray[np.int16]:
    """Return (V, 2) 16-bit octahedral coordinates of unit vectors (V, 3), off by 0.005 degrees at most.

    References
    ----------
    .. [1] Z. Cigolle et al., "A survey of efficient representations for independent unit vectors", Journal of
       Computer Graphics Techniques 3(2), 2014.
    """
    flat = normals / np.maximum(np.abs(normals).sum(1, keepdims=True), 1e-12)
    sign = np.where(flat[:, :2] >= 0, 1.0, -1.0)
    folded = np.where(flat[:, 2:] < 0, (1 - np.abs(flat[:, 1::-1])) * sign, flat[:, :2])
    return np.round(np.clip(folded, -1, 1) * 32767).astype("<i2")


def mesh_entry(mesh: ViewMesh, topologies: Topologies) -> dict[str, Any]:
    """Return a mesh as the viewer reads it; positions are off by half of a 65535th of the box at most."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return {
        "topology": topologies.add(mesh.faces, mesh.uv),
        "positions": encoded(quantized(mesh.vertices, low, high - low).tobytes()),
        "normals": encoded(octahedral(mesh.normals).tobytes()),
        "low": low.tolist(),
        "span": (high - low).tolist(),
    }


def thinned_chart(image: GeometryImage, most: int = MOST_VERTICES) -> ViewMesh:
    """Return the texel grid as a mesh of about `most` vertices or fewer.

    Blocks that lie whole inside the mask become two triangles; those at the rim and at seams keep all of
    theirs, so that no gap opens.
    """
    full = FaceMesh.of_chart(image)
    step = 1
    while int(image.mask.sum()) / step**2 > most:
        step += 1
    if step == 1:
        return ViewMesh.of(full)
    index = np.full(image.shape, -1, np.int64)
    index[image.mask] = np.arange(len(full.vertices))
    rows, columns = (np.arange(0, size - step, step) for size in image.shape)
    whole = np.ones((len(rows), len(columns)), bool)
    for down in range(step + 1):
        for right in range(step + 1):
            whole &= image.mask[np.ix_(rows + down, columns + right)]
    faces = np.concatenate([_coarse(index, rows, columns, step, whole), _fine(full, image, step, whole)])
    agreed = _wound_like(full, faces)
    used = np.unique(agreed)
    place = np.zeros(len(full.vertices), np.int64)
    place[used] = np.arange(len(used))
    return ViewMesh(full.vertices[used], place[agreed], full.uv[used], full.normals[used])


def _coarse(
    index: IntArray, rows: IntArray, columns: IntArray, step: int, whole: NDArray[np.bool_]
) -> IntArray:
    corner = [index[np.ix_(rows + down, columns + right)][whole] for down in (0, step) for right in (0, step)]
    a, b, c, d = corner
    return np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])


def _fine(full: FaceMesh, image: GeometryImage, step: int, whole: NDArray[np.bool_]) -> IntArray:
    """Return the triangles of the texel grid that no whole block covers."""
    row, column = np.nonzero(image.mask)
    first_row, first_column = row[full.faces].min(1) // step, column[full.faces].min(1) // step
    inside = (first_row < whole.shape[0]) & (first_column < whole.shape[1])
    covered = np.zeros(len(full.faces), bool)
    covered[inside] = whole[first_row[inside], first_column[inside]]
    return full.faces[~covered]


def _wound_like(full: FaceMesh, faces: IntArray) -> IntArray:
    """Return the triangles, each wound to agree with the normals at its corners."""
    corners = full.vertices[faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    against = np.einsum("ij,ij->i", outward, full.normals[faces].sum(1)) < 0
    return np.where(against[:, None], faces[:, ::-1], faces)
