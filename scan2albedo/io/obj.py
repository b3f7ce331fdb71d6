"""Wavefront OBJ files: faces share vertices, texture coordinates belong to corners."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ScanError
from scan2albedo.io import text_tables as tables
from scan2albedo.io.atomic import write_text
from scan2albedo.io.color import srgb_to_linear
from scan2albedo.io.mtl import (
    MaterialText,
    find_beside,
    library_names,
    load_material,
    parse_mtl,
    texture_by_name,
)
from scan2albedo.io.parsed_mesh import Material, ParsedMesh, cut_note, fan_triangles


class _Lines:
    """The lines of an OBJ file by kind, with the byte ranges of their bodies."""

    def __init__(self, data: bytes, name: str) -> None:
        if b"\\\n" in data or b"\\\r\n" in data:
            data = data.replace(b"\\\r\n", b"   ").replace(b"\\\n", b"  ")
        if b"\n" not in data:
            data = data.replace(b"\r", b"\n")
        self.name = name
        self.text = np.frombuffer(data, np.uint8)
        begins, self.ends = tables.line_ranges(self.text)
        self.kinds, self.starts = tables.split_keywords(self.text, begins, self.ends)

    def of(self, kind: int) -> IntArray:
        """Return indices of the lines of a kind."""
        return np.flatnonzero(self.kinds == kind)

    def words(self, line: int) -> str:
        """Return the text after the keyword."""
        body = self.text[self.starts[line] : self.ends[line]].tobytes()
        return body.decode("utf-8", "replace").strip()

    def numbers(self, kind: int, width: int, least: int) -> tuple[FloatArray, IntArray]:
        """Return (values (N, width), number of tokens (N,)) of the lines of a kind."""
        lines = self.of(kind)
        values, counts = tables.parse_float_lines(self.text, self.starts[lines], self.ends[lines], width)
        self.raise_for(lines[counts < least], f"expected at least {least} numbers")
        return values, counts

    def raise_for(self, lines: IntArray, expected: str) -> None:
        """Raise a `ScanError` for the first of the given lines, if there is any."""
        if len(lines):
            shown = self.words(int(lines[0]))[:40]
            raise ScanError(
                f"{self.name}: line {lines[0] + 1} holds '{shown}', {expected}; "
                "the file is damaged or truncated: export it again"
            )


def read_obj(path: Path) -> ParsedMesh:
    """Read an OBJ file with its materials.

    Polygons are cut into fans, negative indices count from the end, vertex colours (three numbers after the
    position) are sRGB. Only `map_Kd` and `Kd` of the materials are used; without any material an image of the
    same name is taken for the texture. Raises ScanError, naming file and line, when a line is damaged or an
    index points outside the file.
    """
    lines = _Lines(path.read_bytes(), path.name)
    positions, tokens = lines.numbers(tables.VERTEX, 6, least=3)
    coordinates, _ = lines.numbers(tables.TEXTURE_COORDINATE, 2, least=1)
    corners, counts = _read_corners(lines, len(positions), len(coordinates))
    triangles, face_of_triangle = fan_triangles(counts)
    material, materials, notes = _materials(lines, path.parent)
    uv = _corner_uv(coordinates, corners[:, 1], triangles)
    if uv is not None and not materials and (found := texture_by_name(path)) is not None:
        materials, notes = (found,), (*notes, f"texture {found.name} was found by the scan's name")
    return ParsedMesh(
        vertices=np.ascontiguousarray(positions[:, :3]),
        faces=corners[triangles, 0],
        uv=uv,
        material=None if material is None else material[face_of_triangle],
        materials=materials,
        vertex_color_linear=_vertex_colors(positions, tokens),
        notes=cut_note(counts) + notes,
    )


def write_obj(path: str | Path, vertices: FloatArray, faces: IntArray) -> None:
    """Write the vertices (V, 3) and faces (F, 3) of a mesh, atomically; raises `OutputError`."""
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}\n" for x, y, z in np.asarray(vertices).tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (np.asarray(faces) + 1).tolist()]
    write_text(path, "".join(lines))


def _read_corners(lines: _Lines, vertex_count: int, uv_count: int) -> tuple[IntArray, IntArray]:
    """Return (zero-based (vertex, uv) per corner (N, 2), uv -1 = none; corners per polygon (P,))."""
    rows = lines.of(tables.FACE)
    starts, ends = lines.starts[rows], lines.ends[rows]
    counts = tables.count_tokens(lines.text, starts, ends)
    lines.raise_for(rows[counts < 3], "expected at least 3 corners")
    corners, bad = tables.parse_corners(lines.text, starts, counts)
    lines.raise_for(rows[bad : bad + 1] if bad >= 0 else rows[:0], "expected corners like 1, 1/2 or 1/2/3")
    line_of_corner = np.repeat(rows, counts)
    vertices = (tables.VERTEX, vertex_count, "vertices")
    coordinates = (tables.TEXTURE_COORDINATE, uv_count, "texture coordinates")
    for column, (kind, total, name) in enumerate((vertices, coordinates)):
        written = corners[:, column]
        if (written < 0).any():
            before = np.repeat(np.searchsorted(lines.of(kind), rows), counts)
            written = np.where(written < 0, before + written + 1, written)
            lines.raise_for(line_of_corner[(written < 1) & (corners[:, column] < 0)], "index before 1")
        lines.raise_for(line_of_corner[written > total], f"but there are {total} {name}")
        corners[:, column] = written - 1
    return corners, counts


def _corner_uv(coordinates: FloatArray, index: IntArray, triangles: IntArray) -> FloatArray | None:
    if len(coordinates) == 0 or not (index >= 0).any():
        return None
    corner = index[triangles]
    uv = coordinates[corner]
    uv[corner < 0] = np.nan
    return uv


def _vertex_colors(positions: FloatArray, tokens: IntArray) -> NDArray[np.float32] | None:
    if len(positions) == 0 or not (tokens >= 6).all():
        return None
    srgb = positions[:, 3:6]
    if not np.isfinite(srgb).all() or srgb.min() < 0:
        return None
    return srgb_to_linear(srgb / 255 if srgb.max() > 1 else srgb).astype(np.float32)


def _materials(lines: _Lines, folder: Path) -> tuple[IntArray | None, tuple[Material, ...], tuple[str, ...]]:
    """Return (material index of each polygon or None, materials used, notes)."""
    notes: list[str] = []
    known: dict[str, MaterialText] = {}
    for line in lines.of(tables.MATERIAL_LIBRARY):
        known |= _library(lines.words(int(line)), folder, notes)
    uses, faces = lines.of(tables.USE_MATERIAL), lines.of(tables.FACE)
    if not known:
        return None, (), tuple(notes)
    names = [lines.words(int(line)) for line in uses]
    current = np.searchsorted(uses, faces) - 1
    if not names:
        names, current = [next(iter(known))], np.zeros(len(faces), np.int64)
    order = {name: i for i, name in enumerate(dict.fromkeys(names))}
    number = np.array([order[name] for name in names], np.int64)
    index = np.where(current < 0, -1, number[np.maximum(current, 0)])
    materials = []
    for name in order:
        if name not in known:
            notes.append(f"material {name} is not in the material library: went on without it")
        material, note = load_material(known.get(name, MaterialText(name)), folder)
        materials.append(material)
        notes += [note] if note else []
    return index, tuple(materials), tuple(dict.fromkeys(notes))


def _library(words: str, folder: Path, notes: list[str]) -> dict[str, MaterialText]:
    known: dict[str, MaterialText] = {}
    for name in library_names(words, folder):
        file = find_beside(folder, name)
        if file is None:
            notes.append(f"material library {name} is missing beside the scan: went on without textures")
        else:
            known |= parse_mtl(file.read_text("utf-8", "replace"))
    return known
