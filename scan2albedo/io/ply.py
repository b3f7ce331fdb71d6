"""PLY scans, ASCII or binary: vertex colours, or textures with coordinates a vertex or a corner."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import IntArray
from scan2albedo.errors import ScanError
from scan2albedo.io import limits
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.mtl import MaterialText, ScanPictures
from scan2albedo.io.parsed_mesh import ParsedMesh, cut_note, damaged, fan_triangles, require_few_triangles
from scan2albedo.io.scan_folder import ScanFolder
from scan2albedo.io.text_tables import NumberLines, number_lines, walk_rows

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip

_COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))

_HEADER_END = re.compile(rb"^[ \t]*end_header[ \t]*(?:\r\n|\n|\r)", re.MULTILINE)


class _ListColumn(NamedTuple):
    """A list property: how many entries each row has (N,), and all of them, row after row."""

    counts: IntArray
    items: NDArray[Any]


@dataclass
class _Element:
    """Rows as the header declares them; `properties` are (name, type, type of a list's count or None)."""

    name: str
    count: int
    properties: list[tuple[str, np.dtype[Any], np.dtype[Any] | None]] = field(default_factory=list)


Columns = dict[str, "NDArray[Any] | _ListColumn"]


def read_ply(path: Path, folder: ScanFolder) -> ParsedMesh:
    """Read a PLY file.

    Vertex colours are sRGB, 8 or 16 bits or floats in [0, 1]. Texture coordinates stand with the corners (the
    ``texcoord`` list) or with the vertices, textures in ``TextureFile`` comments. Raises ScanError when the
    file is damaged or holds triangle strips; the message names it.
    """
    elements, texture_files = _read_elements(path)
    columns, face = elements.get("vertex", {}), elements.get("face", {})
    vertex: Columns = {name: values for name, values in columns.items() if isinstance(values, np.ndarray)}
    if "tristrips" in elements and not face:
        raise ScanError(f"{path.name}: holds triangle strips; export it again as plain triangles")
    missing = [axis for axis in "xyz" if axis not in vertex]
    if missing:
        raise ScanError(f"{path.name}: its vertices have no {missing[0]}; export the scan again")
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    index = face.get("vertex_indices", face.get("vertex_index"))
    if not isinstance(index, _ListColumn):
        return ParsedMesh(vertices, np.zeros((0, 3), np.int64))
    if (index.counts < 3).any():
        short = int(np.flatnonzero(index.counts < 3)[0])
        raise ScanError(f"{path.name}: face {short} has {index.counts[short]} corners, expected at least 3")
    require_few_triangles(path.name, index.counts)
    corners, polygon = fan_triangles(index.counts)
    faces = index.items.astype(np.int64)[corners]
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
        per_vertex = np.stack([np.asarray(vertex[name], np.float64) for name in of_vertices], axis=1)
        inside = (faces >= 0) & (faces < len(per_vertex))
        uv = per_vertex[np.where(inside, faces, 0)]
    names = next((names for names in _COLOR_NAMES if all(name in vertex for name in names)), None)
    colors = None
    if names is not None and len(vertices):
        colors = linear_of_srgb_numbers(np.stack([vertex[name] for name in names], axis=1))
        if isinstance(alpha := vertex.get("alpha"), np.ndarray) and np.isfinite(alpha).all():
            colors = np.column_stack([colors, alpha.astype(np.float32)])
    count = len(texture_files)
    limits.require_at_most(path.name, "textures", count, limits.MATERIALS, "join them into one")
    pictures = ScanPictures(folder)
    materials, notes = pictures.materials(MaterialText(name, texture_file=name) for name in texture_files)
    materials, notes = pictures.or_named_like(path, uv, materials, notes)
    number, material = face.get("texnumber"), None
    if len(materials) > 1 and isinstance(number, np.ndarray):
        chosen = number.astype(np.int64)[polygon]
        material = np.where((chosen >= 0) & (chosen < len(materials)), chosen, -1)
    return ParsedMesh(
        vertices=vertices,
        faces=faces,
        uv=uv,
        material=material,
        materials=materials,
        vertex_color_linear=colors,
        notes=cut_note(index.counts) + notes,
    )


def files_of_ply(path: Path, folder: ScanFolder) -> list[str]:
    """Return the names of the textures of a PLY file."""
    with path.open("rb") as file:
        header = file.read(1 << 16).split(b"end_header", maxsplit=1)[0].decode("latin-1")
    return folder.or_named_like(path, _texture_files(header))


def _texture_files(header: str) -> list[str]:
    lines = header.splitlines()
    found = (re.match(r"comment\s+TextureFile\s+(.+)", line, re.IGNORECASE) for line in lines)
    return [match[1].strip() for match in found if match]


def _read_elements(path: Path) -> tuple[dict[str, Columns], list[str]]:
    """Return all values, by element and property name, and the names of textures; ScanError for damage."""
    data = limits.read_bytes(path, advice="decimate it")
    end = _HEADER_END.search(data[: 1 << 20])
    if not data.lstrip()[:3].lower() == b"ply" or end is None:
        raise damaged(path, "it has no complete PLY header", "PLY")
    header = data[: end.start()].decode("latin-1")
    # Byte order "<" or ">", None for text.
    orders = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
    order: str | None = "?"
    elements: list[_Element] = []
    for line in header.splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = orders[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                count_type, item_type = (np.dtype(_TYPES[word]) for word in words[2:4])
                elements[-1].properties.append((words[4], item_type, count_type))
            elif words[:1] == ["property"]:
                elements[-1].properties.append((words[2], np.dtype(_TYPES[words[1]]), None))
        except (LookupError, ValueError) as error:
            raise damaged(path, f"its header holds '{line.strip()[:60]}'", "PLY") from error
    if order == "?" or any(element.count < 0 for element in elements):
        raise damaged(path, "its header names no known format", "PLY")
    for element in elements:
        names = {name for name, _, _ in element.properties}
        if len(names) < max(len(element.properties), min(element.count, 1)):
            raise damaged(path, f"its {element.name} has no properties, or one twice", "PLY")
    for element in elements:
        if element.count <= len(data):  # else it is cut short, which is reported below
            most = {"vertex": limits.VERTICES, "face": limits.TRIANGLES}.get(element.name, limits.TEXT_LINES)
            limits.require_at_most(path.name, f"rows of {element.name}", element.count, most, "decimate it")
        count, what = len(element.properties), f"properties of {element.name}"
        limits.require_at_most(path.name, what, count, limits.MATERIALS, "export it again")
    if order is None:
        columns = _ascii_columns(path, number_lines(data, end.end(), path.name), elements)
        return columns, _texture_files(header)
    columns, body = {}, np.frombuffer(data, np.uint8, offset=end.end())
    for element in elements:
        result = _uniform_rows(body, element, order)
        # A property of a row has a byte at least: a count beyond the file is not worth making room for.
        cells = element.count * len(element.properties)
        if result is None and cells <= len(body):
            what = f"properties of {element.name} with lists of several lengths"
            limits.require_at_most(path.name, what, cells, 8 * limits.TRIANGLES, "decimate it")
            result = _ragged_rows(body, element, order)
        if result is None:
            raise _cut_short(path, element)
        columns[element.name], size = result
        body = body[size:]
    return columns, _texture_files(header)


def _ascii_columns(path: Path, lines: NumberLines, elements: list[_Element]) -> dict[str, Columns]:
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
            raise damaged(path, f"{element.name} {table.bad} is not made of numbers", "PLY")
        found = columns[element.name] = {}
        column = np.zeros(element.count, np.int64)
        for name, item_type, count_type in element.properties:
            if (short := np.flatnonzero(column >= table.counts)).size:
                raise damaged(path, f"{element.name} {short[0]} is cut short", "PLY")
            values = table.values[table.first + column]
            column = column + 1
            counts = None
            if count_type is not None:
                if not ((values >= 0) & (column + values <= table.counts)).all():  # NaN is neither
                    raise damaged(path, f"a list {name} of {element.name} is cut short", "PLY")
                counts = values.astype(np.int64)
                values = table.ranges(column, counts)
                column = column + counts
            if item_type.kind in "iu":
                bounds = np.iinfo(item_type)
                fits = (values >= bounds.min) & (values < float(bounds.max) + 1)
                if not fits.all():
                    wrong = f"{values[~fits][0]:g}, which {item_type.name} cannot hold"
                    raise damaged(path, f"{name} of {element.name} holds {wrong}", "PLY")
            with np.errstate(over="ignore"):  # to infinity; infinite vertices in use raise later
                items = values.astype(item_type)
            found[name] = items if counts is None else _ListColumn(counts, items)
    return columns


def _cut_short(path: Path, element: _Element) -> ScanError:
    what = f"it declares {element.count} {element.name} rows, but ends before that"
    return damaged(path, what, "PLY")


def _uniform_rows(body: NDArray[np.uint8], element: _Element, order: str) -> tuple[Columns, int] | None:
    """Return (columns, bytes of all rows); None where lists differ in length or the body ends before."""
    lengths: dict[str, int] = {}
    fields: list[Any] = []
    for name, item_type, count_type in element.properties:
        shape: tuple[int, ...] = ()
        if count_type is not None:
            start, count_type = np.dtype(fields).itemsize, count_type.newbyteorder(order)  # type: ignore[arg-type]
            fields.append((f"#{name}", count_type))
            if element.count:
                if start + count_type.itemsize > len(body):
                    return None
                lengths[name] = int(body[start : start + count_type.itemsize].view(count_type)[0])
                if not 0 <= lengths[name] * item_type.itemsize <= len(body):
                    return None
            shape = (lengths.get(name, 0),)
        fields.append((name, item_type.newbyteorder(order), shape))  # type: ignore[arg-type]
    row_type = np.dtype(fields)
    size = row_type.itemsize * element.count
    if size > len(body):
        return None
    rows = body[:size].view(row_type) if size else np.zeros(element.count, row_type)
    if any((rows[f"#{name}"] != length).any() for name, length in lengths.items()):
        return None
    columns: Columns = {}
    for name, item_type, count_type in element.properties:
        values = rows[name].astype(item_type)
        if count_type is not None:
            columns[name] = _ListColumn(rows[f"#{name}"].astype(np.int64), values.reshape(-1))
        else:
            columns[name] = values
    return columns, size


def _ragged_rows(body: NDArray[np.uint8], element: _Element, order: str) -> tuple[Columns, int] | None:
    """Read rows whose lists differ in length: walk once for the offsets, then gather by length."""
    items = np.array([item_type.itemsize for _, item_type, _ in element.properties])
    counters = np.array([count_type.itemsize if count_type else 0 for _, _, count_type in element.properties])
    offsets, counts, size = walk_rows(body, element.count, items, counters, order == ">")
    if size < 0:
        return None
    columns: Columns = {}
    for i, (name, item_type, count_type) in enumerate(element.properties):
        bytes_per_row = counts[:, i] * items[i]
        first = np.cumsum(bytes_per_row) - bytes_per_row
        source = np.arange(int(bytes_per_row.sum())) + np.repeat(offsets[:, i] - first, bytes_per_row)
        values = body[source].view(item_type.newbyteorder(order)).astype(item_type)  # type: ignore[arg-type]
        columns[name] = values if count_type is None else _ListColumn(counts[:, i], values)
    return columns, size
