"""Several meshes of one colour each, opaque or not, as one GLB file that any viewer opens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.geometry.mesh import vertex_normals, without_unreferenced
from scan2albedo.io.atomic import write_bytes
from scan2albedo.io.glb import METRES_PER_MM
from scan2albedo.io.glb_buffer import INDICES, VERTEX_DATA, GlbBuffer, glb_bytes


@dataclass(frozen=True)
class GlbPart:
    """A mesh with its material."""

    name: str
    vertices: ArrayLike
    """(V, 3) mm."""
    faces: ArrayLike
    """(F, 3)"""
    color_linear: tuple[float, float, float]
    opacity: float = 1.0
    roughness: float = 0.6


def write_parts_glb(path: str | Path, parts: Sequence[GlbPart]) -> None:
    """Write meshes as binary glTF 2.0, atomically; lengths as metres, glTF's unit.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    ValueError
        When there is no part, a part has no faces, or numbers are not finite.
    """
    if not parts:
        raise ValueError("a GLB file needs a mesh")
    buffer = GlbBuffer()
    meshes = [_mesh(buffer, part, number) for number, part in enumerate(parts)]
    tree = {
        "asset": {"version": "2.0", "generator": "scan2albedo"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(parts)))}],
        "nodes": [{"name": part.name, "mesh": number} for number, part in enumerate(parts)],
        "meshes": meshes,
        "materials": [_material(part) for part in parts],
        **buffer.entries(),
    }
    write_bytes(path, glb_bytes(tree, bytes(buffer.data)))


def _mesh(buffer: GlbBuffer, part: GlbPart, material: int) -> dict[str, Any]:
    vertices, faces = np.asarray(part.vertices, np.float64), np.asarray(part.faces, np.int64)
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise ValueError(f"{part.name!r} needs faces and finite vertices")
    kept, renumbered = without_unreferenced(vertices, faces)
    places = vertices[kept] * METRES_PER_MM
    normals = vertex_normals(places, renumbered)
    normals[~normals.any(1)] = (0.0, 0.0, 1.0)
    attributes = {
        "POSITION": buffer.add(places.astype("f4"), "VEC3", VERTEX_DATA, bounds=True),
        "NORMAL": buffer.add(normals.astype("f4"), "VEC3", VERTEX_DATA),
    }
    indices = buffer.add(renumbered.astype("u4").ravel(), "SCALAR", INDICES)
    primitive = {"attributes": attributes, "indices": indices, "material": material}
    return {"name": part.name, "primitives": [primitive]}


def _material(part: GlbPart) -> dict[str, Any]:
    color = np.clip([*part.color_linear, part.opacity], 0, 1)
    material: dict[str, Any] = {
        "name": part.name,
        "doubleSided": True,
        "pbrMetallicRoughness": {
            "baseColorFactor": color.tolist(),
            "metallicFactor": 0.0,
            "roughnessFactor": part.roughness,
        },
    }
    return material if part.opacity >= 1 else {**material, "alphaMode": "BLEND"}
