"""Wavefront OBJ files: faces share vertices, texture coordinates belong to corners."""

from __future__ import annotations

import codecs
from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ScanError
from scan2albedo.io import limits
from scan2albedo.io import text_tables as tables
from scan2albedo.io.atomic import write_text
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.mtl import MaterialText, ScanPictures, decoded, parse_mtl
from scan2albedo.io.parsed_mesh import Material, ParsedMesh, cut_note, fan_triangles
from scan2albedo.io.scan_folder import ScanFolder


class _Lines:
    """The lines of an OBJ file by kind, with the byte ranges of their bodies."""

    def __init__(self, data: bytes, name: str) -> None:
        data = data.removeprefix(codecs.BOM_UTF8)
        if b"\\\n" in data or b"\\\r\n" in data:
            data = data.replace(b"\\\r\n", b"   ").replace(b"\\\n", b"  ")
        if b"\n" not in data:
            data = data.replace(b"\r", b"\n")
        limits.require_at_most(name, "lines", data.count(b"\n"), limits.TEXT_LINES, "decimate it")
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
        return decoded(body).strip()

    def names(self, kind: int) -> list[str]:
        """Return the text of all lines of a kind, which are names."""
        lines = self.of(kind)
        limits.require_at_most(self.name, "lines of names", len(lines), limits.NAME_LINES, "export it again")
        self.raise_for(
            lines[self.ends[lines] - self.starts[lines] > limits.NAME_BYTES],
            f"expected a name of at most {limits.NAME_BYTES} bytes",
        )
        return [self.words(int(line)) for line in lines]

    def numbers(self, kind: int, width: int, least: int, most: int) -> tuple[FloatArray, IntArray]:
        """Return (values (N, width), number of tokens (N,)) of the lines of a kind."""
        lines = self.of(kind)
        limits.require_at_most(self.name, "vertices", len(lines), most, "decimate it")
        values, counts = tables.parse_float_lines(self.text, self.starts[lines], self.ends[lines], width)
        self.raise_for(lines[counts < least], f"expected at least {least} numbers")
        return values, counts

    def raise_for(self, lines: IntArray, expected: str) -> None:
        """Raise a `ScanError` for the first of the given lines, if there is any."""
        if len(lines):
            start, end = int(self.starts[lines[0]]), int(self.ends[lines[0]])
            beginning = decoded(self.text[start : min(end, start + 50)].tobytes()).strip()[:40]
            raise ScanError(
                f"{self.name}: line {lines[0] + 1} holds '{beginning}', {expected}; "
                "the file is damaged or truncated: export it again"
            )


def read_obj(path: Path, textures: Path | None = None) -> ParsedMesh:
    """Read an OBJ file with its materials.

    Polygons are cut into fans, negative indices count from the end, vertex colours (three numbers after the
    position) are sRGB. Only `map_Kd` and `Kd` of the materials are used; where the material library, or every
    texture that it names, is missing, an image of the scan's own name is taken for the texture. Raises
    ScanError, naming file and line, when a line is damaged or an index points outside the file; TooLargeError
    for more than is read.
    """
    lines = _Lines(limits.read_bytes(path, advice="decimate it"), path.name)
    positions, tokens = lines.numbers(tables.VERTEX, 6, least=3, most=limits.VERTICES)
    coordinates, _ = lines.numbers(tables.TEXTURE_COORDINATE, 2, least=1, most=limits.TEXT_LINES)
    corners, counts = _read_corners(lines, len(positions), len(coordinates))
    triangles, face_of_triangle = fan_triangles(counts)
    pictures = ScanPictures(ScanFolder(path.parent, textures))
    material, materials, notes = _materials(lines, pictures)
    uv = None
    if len(coordinates) and (corners[:, 1] >= 0).any():
        corner = corners[triangles, 1]
        uv = np.where((corner >= 0)[..., None], coordinates[corner], np.nan)
    srgb, colors = positions[:, 3:6], None
    # Numbers below 0 are not colours, but normals.
    if len(positions) and (tokens >= 6).all() and np.isfinite(srgb).all() and srgb.min() >= 0:
        colors = linear_of_srgb_numbers(srgb)
    lost = not materials or any(note.startswith("texture ") for note in notes)
    lost = lost and uv is not None and all(m.texture_linear is None for m in materials)
    if lost and (found := pictures.named_like(path)) is not None:
        material, materials = None, (found,)
        lacking = (note.partition(": went on without")[0] for note in notes)
        notes = (*lacking, f"texture {found.name} was found by the scan's name")
    return ParsedMesh(
        vertices=np.ascontiguousarray(positions[:, :3]),
        faces=corners[triangles, 0],
        uv=uv,
        material=None if material is None else material[face_of_triangle],
        materials=materials,
        vertex_color_linear=colors,
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
    triangles = int(counts.sum()) - 2 * len(counts)
    limits.require_at_most(lines.name, "triangles", triangles, limits.TRIANGLES, "decimate it")
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


def _materials(
    lines: _Lines, pictures: ScanPictures
) -> tuple[IntArray | None, tuple[Material, ...], tuple[str, ...]]:
    """Return (material index of each polygon or None, materials used, notes)."""
    notes: list[str] = []
    known = _libraries(lines, pictures.folder, notes)
    if not known:
        return None, (), tuple(notes)
    uses, faces = lines.of(tables.USE_MATERIAL), lines.of(tables.FACE)
    names = lines.names(tables.USE_MATERIAL)
    current = np.searchsorted(uses, faces) - 1
    if not names:
        names, current = [next(iter(known))], np.zeros(len(faces), np.int64)
    order = {name: i for i, name in enumerate(dict.fromkeys(names))}
    limits.require_at_most(lines.name, "materials", len(order), limits.MATERIALS, "join its materials")
    number = np.array([order[name] for name in names], np.int64)
    index = np.where(current < 0, -1, number[np.maximum(current, 0)])
    materials = []
    for name in order:
        if name not in known:
            notes.append(f"material {name} is not in the material library: went on without it")
        material, note = pictures.material(known.get(name, MaterialText(name)))
        materials.append(material)
        notes += [note] if note else []
    return index, tuple(materials), tuple(dict.fromkeys(notes))


def _libraries(lines: _Lines, folder: ScanFolder, notes: list[str]) -> dict[str, MaterialText]:
    """Return the materials of all libraries that the file names, by name."""
    known: dict[str, MaterialText] = {}
    words = list(dict.fromkeys(lines.names(tables.MATERIAL_LIBRARY)))
    limits.require_at_most(lines.name, "material libraries", len(words), limits.MATERIALS, "join them")
    total = 0
    for name in (name for line in words for name in folder.library_names(line)):
        file = folder.find(name)
        if file is None:
            notes.append(f"material library {name} {folder.why_missing(name)}: went on without textures")
            continue
        data = limits.read_bytes(file, limits.LIBRARY_BYTES, "export the scan again")
        total += len(data)
        place = f"the material libraries of {lines.name}"
        limits.require_at_most(place, "bytes", total, limits.LIBRARY_BYTES, "export the scan again")
        known |= parse_mtl(decoded(data))
    return known
