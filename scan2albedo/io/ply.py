"""PLY scans: vertex colours, or textures with coordinates a vertex or a corner."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ScanError
from scan2albedo.io.color import decode_srgb_integers, srgb_to_linear
from scan2albedo.io.mtl import MaterialText, load_material
from scan2albedo.io.parsed_mesh import Material, ParsedMesh, cut_note, fan_triangles
from scan2albedo.io.ply_elements import Columns, ListColumn, read_ply_elements

_COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))


def read_ply(path: Path) -> ParsedMesh:
    """Read a PLY file.

    Vertex colours are sRGB, 8 or 16 bits or floats in [0, 1]. Texture coordinates stand with the corners
    (the ``texcoord`` list) or with the vertices, textures in ``TextureFile`` comments.

    Raises
    ------
    ScanError
        When the file is damaged or holds triangle strips; the message names it.
    """
    file = read_ply_elements(path)
    columns, face = file.elements.get("vertex", {}), file.elements.get("face", {})
    vertex: Columns = {name: values for name, values in columns.items() if isinstance(values, np.ndarray)}
    if "tristrips" in file.elements and not face:
        raise ScanError(f"{path.name}: holds triangle strips; export it again as plain triangles")
    missing = [axis for axis in "xyz" if axis not in vertex]
    if missing:
        raise ScanError(f"{path.name}: its vertices have no {missing[0]}; export the scan again")
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    index = face.get("vertex_indices", face.get("vertex_index"))
    if not isinstance(index, ListColumn):
        return ParsedMesh(vertices, np.zeros((0, 3), np.int64))
    if (index.counts < 3).any():
        short = int(np.flatnonzero(index.counts < 3)[0])
        raise ScanError(f"{path.name}: face {short} has {index.counts[short]} corners, expected at least 3")
    corners, polygon = fan_triangles(index.counts)
    faces = index.items.astype(np.int64)[corners]
    materials, notes = _textures(file.texture_files, path.parent)
    return ParsedMesh(
        vertices=vertices,
        faces=faces,
        uv=_corner_uv(vertex, face, index, faces, corners),
        material=_texture_of_face(face, polygon, len(materials)),
        materials=materials,
        vertex_color_linear=_vertex_colors(vertex),
        notes=cut_note(index.counts) + notes,
    )


def _textures(names: tuple[str, ...], folder: Path) -> tuple[tuple[Material, ...], tuple[str, ...]]:
    loaded = [load_material(MaterialText(name, texture_file=name), folder) for name in names]
    return tuple(m for m, _ in loaded), tuple(note for _, note in loaded if note)


def _texture_of_face(face: Columns, polygon: NDArray[np.int64], count: int) -> NDArray[np.int64] | None:
    number = face.get("texnumber")
    if count < 2 or not isinstance(number, np.ndarray):
        return None
    chosen = number.astype(np.int64)[polygon]
    return np.where((chosen >= 0) & (chosen < count), chosen, -1)


def _corner_uv(
    vertex: Columns, face: Columns, index: ListColumn, faces: NDArray[np.int64], corners: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    listed = face.get("texcoord")
    if isinstance(listed, ListColumn):
        complete = listed.counts == 2 * index.counts
        uv = np.full((len(index.items), 2), np.nan)
        uv[np.repeat(complete, index.counts)] = listed.items[np.repeat(complete, listed.counts)].reshape(
            -1, 2
        )
        return uv[corners] if complete.any() else None
    for names in _UV_NAMES:
        if all(name in vertex for name in names):
            per_vertex = np.stack([np.asarray(vertex[name], np.float64) for name in names], axis=1)
            inside = (faces >= 0) & (faces < len(per_vertex))
            return per_vertex[np.where(inside, faces, 0)]
    return None


def _vertex_colors(vertex: Columns) -> NDArray[np.float32] | None:
    for names in _COLOR_NAMES:
        if all(name in vertex for name in names):
            colors = np.stack([np.asarray(vertex[name]) for name in names], axis=1)
            return _linear(colors) if len(colors) else None
    return None


def _linear(colors: NDArray[Any]) -> NDArray[np.float32]:
    if colors.dtype in (np.uint8, np.uint16):
        return decode_srgb_integers(colors)
    values = np.nan_to_num(colors.astype(np.float64)).clip(0)
    return srgb_to_linear(values / 255 if values.max() > 1 else values).astype(np.float32)
