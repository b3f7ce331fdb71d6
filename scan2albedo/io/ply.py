"""PLY scans with colours or textures; STL scans; OFF scans, ASCII, with vertex colours when they are COFF."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scan2albedo.core.arrays import ByteArray, Float32Array, IntArray, NDArray, all_finite
from scan2albedo.errors import ScanError
from scan2albedo.geometry.operators import vertex_average
from scan2albedo.io import limits, parsed_mesh
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.obj import ObjLines
from scan2albedo.io.parsed_mesh import GREY, Material, ParsedMesh, ScanFolder, ScanPictures, damaged
from scan2albedo.io.text_tables import NumberLines, byte_ranges, number_lines, walk_rows

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}

_COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))

_HEADER_END = re.compile(rb"^[ \t]*end_header[ \t]*(?:\r\n|\n|\r)", re.MULTILINE)


class _ListColumn(NamedTuple):
    """A list property: how many entries each row has (N,), and all of them, row after row."""

    counts: IntArray
    items: NDArray


@dataclass
class Element:
    """Rows as the header declares them; `properties` are (name, type, type of a list's count or None)."""

    name: str
    count: int
    properties: list[tuple[str, np.dtype[Any], np.dtype[Any] | None]] = field(default_factory=list)


Columns = dict[str, "NDArray | _ListColumn"]


def read_ply(path: Path, folder: ScanFolder) -> ParsedMesh:
    """Read a PLY file.

    Colours of vertices, else of faces, are sRGB, 8 or 16 bits or floats in [0, 1]. Texture coordinates stand
    with the corners (the ``texcoord`` list) or with the vertices, textures in ``TextureFile`` comments.
    Raises ScanError when the file is damaged; the message names it.
    """
    data = limits.read_bytes(path, advice="decimate it")
    end = _HEADER_END.search(data[: 1 << 20])
    if not data.lstrip()[:3].lower() == b"ply" or end is None:
        raise damaged(path, "it has no complete PLY header")
    header = data[: end.start()].decode("latin-1")
    # Byte order "<" or ">", None for text.
    orders = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
    order: str | None = "?"
    elements: list[Element] = []
    for line in header.splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = orders[words[1]]
            elif words[:1] == ["element"]:
                elements.append(Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                count_type, item_type = (np.dtype(_TYPES[word]) for word in words[2:4])
                elements[-1].properties.append((words[4], item_type, count_type))
            elif words[:1] == ["property"]:
                elements[-1].properties.append((words[2], np.dtype(_TYPES[words[1]]), None))
        except (LookupError, ValueError) as error:
            raise damaged(path, f"its header holds '{line.strip()[:60]}'") from error
    if order == "?" or any(element.count < 0 for element in elements):
        raise damaged(path, "its header names no known format")
    for element in elements:
        names = {name for name, _, _ in element.properties}
        if len(names) < max(len(element.properties), min(element.count, 1)):
            raise damaged(path, f"its {element.name} has no properties, or one twice")
    for element in elements:
        if element.count <= len(data):  # else it is cut short, which is reported below
            most = {"vertex": limits.VERTICES, "face": limits.TRIANGLES}.get(element.name, limits.TEXT_LINES)
            limits.require_at_most(path.name, f"rows of {element.name}", element.count, most, "decimate it")
        count, what = len(element.properties), f"properties of {element.name}"
        limits.require_at_most(path.name, what, count, limits.MATERIALS, "export it again")
    if order is None:
        columns = ascii_columns(path, number_lines(data, end.end(), path.name), elements)
    else:
        columns, body = {}, np.frombuffer(data, np.uint8, offset=end.end())
        for element in elements:
            columns[element.name], size = _binary_rows(path, body, element, order)
            body = body[size:]
    return mesh_of_columns(path, folder, columns, _texture_files(header))


def mesh_of_columns(
    path: Path, folder: ScanFolder, elements: dict[str, Columns], texture_files: list[str]
) -> ParsedMesh:
    """Return the mesh of a file's elements, named as those of PLY, with its textures."""
    face = elements.get("face", {})
    vertex, of_face = (
        {name: values for name, values in elements.get(kind, {}).items() if isinstance(values, np.ndarray)}
        for kind in ("vertex", "face")
    )
    strips = elements.get("tristrips", {}).get("vertex_indices")
    if isinstance(strips, _ListColumn) and not face:
        # Strips end with their row, or at an index below 0.
        items = np.insert(strips.items.astype(int), np.cumsum(strips.counts), -1)
        rows = parsed_mesh.strip_triangles(items)
        face = {"vertex_indices": _ListColumn(np.full(len(rows), 3), rows.ravel())}
    missing = [axis for axis in "xyz" if axis not in vertex]
    if missing:
        raise ScanError(f"{path.name}: its vertices have no {missing[0]}; export the scan again")
    vertices = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(float)
    index = face.get("vertex_indices", face.get("vertex_index"))
    if not isinstance(index, _ListColumn):
        return ParsedMesh(vertices, np.zeros((0, 3), int))
    if (index.counts < 3).any():
        short = int(np.flatnonzero(index.counts < 3)[0])
        raise ScanError(f"{path.name}: face {short} has {index.counts[short]} corners, expected at least 3")
    corners, polygon = parsed_mesh.fan_triangles(index.counts, path.name)
    faces = index.items.astype(int)[corners]
    # Texture coordinates of the corners, else of the vertices.
    uv, listed = None, face.get("texcoord")
    of_vertices = next((names for names in _UV_NAMES if all(name in vertex for name in names)), None)
    if isinstance(listed, _ListColumn):
        complete = listed.counts == 2 * index.counts
        of_corners = np.full((len(index.items), 2), np.nan)
        whole = listed.items[np.repeat(complete, listed.counts)]
        of_corners[np.repeat(complete, index.counts)] = whole.reshape(-1, 2)
        uv = of_corners[corners] if complete.any() else None
    elif of_vertices is not None:
        per_vertex = np.stack([vertex[name] for name in of_vertices], axis=1).astype(float)
        uv = per_vertex[np.where((faces >= 0) & (faces < len(per_vertex)), faces, 0)]
    colors = _colors(vertex)
    if colors is None and (of_faces := _colors(of_face)) is not None:
        known = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
        around = of_faces[polygon[known]].T.astype(float)
        means = [vertex_average(len(vertices), faces[known], channel) for channel in around]
        colors = np.stack(means, axis=1).astype(np.float32)
    limits.require_at_most(path.name, "textures", len(texture_files), limits.MATERIALS, "join them into one")
    pictures = ScanPictures(folder)
    untextured = [Material(name, None, GREY, texture_file=name) for name in texture_files]
    materials, notes = pictures.materials(untextured)
    materials, notes = pictures.with_stem_fallback(path, uv, materials, notes)
    material = None
    if len(materials) > 1 and "texnumber" in of_face:
        chosen = of_face["texnumber"].astype(int)[polygon]
        material = np.where((chosen >= 0) & (chosen < len(materials)), chosen, -1)
    notes = parsed_mesh.cut_note(index.counts) + notes
    return ParsedMesh(vertices, faces, uv, material, materials, vertex_color_linear=colors, notes=notes)


def _colors(columns: dict[str, NDArray]) -> Float32Array | None:
    """Return the linear colours (N, 3) of rows, or with alpha (N, 4); None where they have none."""
    names = next((names for names in _COLOR_NAMES if all(name in columns for name in names)), None)
    if names is None or not len(columns[names[0]]):
        return None
    colors = linear_of_srgb_numbers(np.stack([columns[name] for name in names], axis=1))
    if "alpha" in columns and all_finite(columns["alpha"]):
        colors = np.column_stack([colors, columns["alpha"].astype(np.float32)])
    return colors


def files_of_ply(path: Path, folder: ScanFolder) -> list[str]:
    """Return the names of the textures of a PLY file."""
    with path.open("rb") as file:
        header = file.read(1 << 16).split(b"end_header", maxsplit=1)[0].decode("latin-1")
    return folder.with_stem_fallback(path, _texture_files(header))


def _texture_files(header: str) -> list[str]:
    found = (re.match(r"comment\s+TextureFile\s+(.+)", line, re.IGNORECASE) for line in header.splitlines())
    return [match[1].strip() for match in found if match]


def ascii_columns(path: Path, lines: NumberLines, elements: list[Element]) -> dict[str, Columns]:
    """Split rows of numbers into properties; a list takes its count and its entries."""
    columns: dict[str, Columns] = {}
    row = 0
    for element in elements:
        rows = slice(row, row + element.count)
        row += element.count
        if len(lines.counts[rows]) < element.count:
            raise _cut_short(path, element)
        table = lines.table(rows)
        if table.bad >= 0:
            raise damaged(path, f"{element.name} {table.bad} is not made of numbers")
        found = columns[element.name] = {}
        column = np.zeros(element.count, int)
        for name, item_type, count_type in element.properties:
            if (short := np.flatnonzero(column >= table.counts)).size:
                raise damaged(path, f"{element.name} {short[0]} is cut short")
            values = table.values[table.first + column]
            column = column + 1
            counts = None
            if count_type is not None:
                if not ((values >= 0) & (column + values <= table.counts)).all():  # NaN is neither
                    raise damaged(path, f"a list {name} of {element.name} is cut short")
                counts = values.astype(int)
                values = table.ranges(column, counts)
                column = column + counts
            if item_type.kind in "iu":
                bounds = np.iinfo(item_type)
                fits = (values >= bounds.min) & (values < float(bounds.max) + 1)
                if not fits.all():
                    wrong = f"{values[~fits][0]:g}, which {item_type.name} cannot hold"
                    raise damaged(path, f"{name} of {element.name} holds {wrong}")
            with np.errstate(over="ignore"):  # to infinity; infinite vertices in use raise later
                items = values.astype(item_type)
            found[name] = items if counts is None else _ListColumn(counts, items)
    return columns


def _cut_short(path: Path, element: Element) -> ScanError:
    return damaged(path, f"it declares {element.count} {element.name} rows, but ends before that")


def _binary_rows(path: Path, body: ByteArray, element: Element, order: str) -> tuple[Columns, int]:
    """Return (columns, bytes of all rows); ScanError where the body ends before."""
    types = [(name, item_type.newbyteorder(order)) for name, item_type, _ in element.properties]  # type: ignore[arg-type]
    if all(count_type is None for _, _, count_type in element.properties):
        size = np.dtype(types).itemsize * element.count
        if size > len(body):
            raise _cut_short(path, element)
        rows = np.ndarray(element.count, np.dtype(types), body)
        return {name: rows[name].astype(item_type) for name, item_type, _ in element.properties}, size
    # A property of a row has a byte at least: a count beyond the file is not worth making room for.
    cells = element.count * len(types)
    if cells > len(body):
        raise _cut_short(path, element)
    what = f"properties of {element.name} in all its rows"
    limits.require_at_most(path.name, what, cells, 8 * limits.TRIANGLES, "decimate it")
    items = np.array([item_type.itemsize for _, item_type in types])
    counters = np.array([count_type.itemsize if count_type else 0 for _, _, count_type in element.properties])
    offsets, counts, size = walk_rows(body, element.count, items, counters, order == ">")
    if size < 0:
        raise _cut_short(path, element)
    columns: Columns = {}
    for i, (name, item_type, count_type) in enumerate(element.properties):
        values = byte_ranges(body, offsets[:, i], counts[:, i] * items[i]).view(types[i][1]).astype(item_type)
        columns[name] = values if count_type is None else _ListColumn(counts[:, i], values)
    return columns, size


_HEADER = re.compile(rb"^(?:\s*#[^\n]*\n)*\s*(ST)?(C)?(N)?OFF(?:[ \t]+BINARY)?")


def read_stl(path: Path, _folder: ScanFolder) -> ParsedMesh:
    """Read a binary or ASCII STL file. Raises ScanError, naming it, when it is damaged, cut or empty."""
    data = limits.read_bytes(path, advice="decimate it")
    declared = int.from_bytes(data[80:84], "little")
    needed = 84 + 50 * declared
    if len(data) == needed:
        limits.require_at_most(path.name, "triangles", declared, limits.TRIANGLES, "decimate it")
        triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        with np.errstate(invalid="ignore"):  # of damaged bytes; `require_usable` names what is no number
            corners = np.ndarray(declared, triangle, data, 84)["corners"].astype(float)
    elif b"endsolid" in data[-4096:].lower() and b"\0" not in data[:512]:
        words = data.lower()
        if re.search(rb"^[ \t]*vertex\s", words, re.MULTILINE) is None:  # several on a line
            words = words.replace(b"vertex", b"\nvertex")
        corners, _ = ObjLines(words, path.name).numbers(b"vertex", 3, least=3, most=limits.TEXT_LINES)
        if len(corners) % 3:
            raise damaged(path, "a triangle has not three vertices")
    else:
        what = f"it has {len(data)} bytes, but {declared} triangles need {needed}"
        raise damaged(path, f"{what}, and it does not end with endsolid")
    if corners.size == 0:
        raise damaged(path, "it holds no triangles")
    return ParsedMesh(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))


def read_off(path: Path, folder: ScanFolder) -> ParsedMesh:
    """Read an ASCII OFF file. Raises ScanError, naming it, when it is damaged, binary or cut short."""
    data = limits.read_bytes(path, advice="decimate it")
    header = _HEADER.match(data)
    if header is None:
        raise damaged(path, "it does not begin with OFF")
    if header[0].endswith(b"BINARY"):
        raise damaged(path, "binary OFF is not supported")
    lines = number_lines(data, header.end(), path.name)
    head, rows = lines.table(slice(1)), NumberLines(lines.text, *(column[1:] for column in lines[1:]))
    counts = head.values[:2]
    if head.bad >= 0 or len(counts) < 2 or not ((counts >= 0) & (counts < limits.TEXT_LINES)).all():  # or NaN
        raise damaged(path, "its counts are not numbers that a file has")
    names, number = ["x", "y", "z"], np.dtype(np.float64)
    vertex, face = (Element(name, int(n)) for name, n in zip(("vertex", "face"), counts, strict=True))
    plain = bool(header[2]) and not (header[1] or header[3])  # colours without normals or coordinates
    if plain and vertex.count and rows.counts[: vertex.count].min(initial=6) >= 6:
        names += ["red", "green", "blue"]
    vertex.properties += [(name, number, None) for name in names]
    face.properties.append(("vertex_indices", np.dtype(np.int64), number))
    return mesh_of_columns(path, folder, ascii_columns(path, rows, [vertex, face]), [])
