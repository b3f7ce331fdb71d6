"""PLY scans, ASCII or binary: vertex colours, or textures with coordinates a vertex or a corner."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ScanError
from scan2albedo.io import limits
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.mtl import MaterialText, ScanPictures
from scan2albedo.io.parsed_mesh import ParsedMesh, cut_note, fan_triangles
from scan2albedo.io.scan_folder import ScanFolder
from scan2albedo.io.text_tables import NumberLines, NumberTable, number_lines, walk_rows

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip

_COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))

_HEADER_END = re.compile(rb"^[ \t]*end_header[ \t]*(?:\r\n|\n|\r)", re.MULTILINE)


class _Property(NamedTuple):
    """One property; `count_type` is None unless it is a list."""

    name: str
    item_type: np.dtype[Any]
    count_type: np.dtype[Any] | None


class _ListColumn(NamedTuple):
    """A list property of all rows."""

    counts: IntArray
    """(N,) entries of each row."""
    items: NDArray[Any]
    """All entries, row after row."""


@dataclass
class _Element:
    """One kind of row, such as vertex or face, as the header declares it."""

    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


Columns = dict[str, "NDArray[Any] | _ListColumn"]


@dataclass(frozen=True)
class _PlyFile:
    """Values of every element, by element and property name, and the texture files of the comments."""

    elements: dict[str, Columns]
    texture_files: tuple[str, ...]


def read_ply(path: Path, textures: Path | None = None) -> ParsedMesh:
    """Read a PLY file.

    Vertex colours are sRGB, 8 or 16 bits or floats in [0, 1]. Texture coordinates stand with the corners (the
    ``texcoord`` list) or with the vertices, textures in ``TextureFile`` comments. Raises ScanError when the
    file is damaged or holds triangle strips; the message names it.
    """
    file = _read_elements(path)
    columns, face = file.elements.get("vertex", {}), file.elements.get("face", {})
    vertex: Columns = {name: values for name, values in columns.items() if isinstance(values, np.ndarray)}
    if "tristrips" in file.elements and not face:
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
    triangles = len(index.items) - 2 * len(index.counts)
    limits.require_at_most(path.name, "triangles", triangles, limits.TRIANGLES, "decimate it")
    corners, polygon = fan_triangles(index.counts)
    faces = index.items.astype(np.int64)[corners]
    uv = _corner_uv(vertex, face, index, faces, corners)
    names = next((names for names in _COLOR_NAMES if all(name in vertex for name in names)), None)
    colors = None
    if names is not None and len(vertices):
        colors = linear_of_srgb_numbers(np.stack([vertex[name] for name in names], axis=1))
    count = len(file.texture_files)
    limits.require_at_most(path.name, "textures", count, limits.MATERIALS, "join them into one")
    pictures = ScanPictures(ScanFolder(path.parent, textures))
    loaded = [pictures.material(MaterialText(name, texture_file=name)) for name in file.texture_files]
    materials, notes = tuple(m for m, _ in loaded), tuple(note for _, note in loaded if note)
    lost = uv is not None and all(m.texture_linear is None for m in materials)
    if lost and (found := pictures.named_like(path)) is not None:
        materials = (found,)
        notes = (*notes, f"texture {found.name} was found by the scan's name")
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


def _corner_uv(
    vertex: Columns, face: Columns, index: _ListColumn, faces: IntArray, corners: IntArray
) -> FloatArray | None:
    listed = face.get("texcoord")
    if isinstance(listed, _ListColumn):
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


def _read_elements(path: Path) -> _PlyFile:
    """Read all elements; ScanError, naming the file, for a damaged header or a body cut short."""
    data = limits.read_bytes(path, advice="decimate it")
    end = _HEADER_END.search(data[: 1 << 20])
    if not data.lstrip()[:3].lower() == b"ply" or end is None:
        raise _damaged(path, "it has no complete PLY header")
    lines = data[: end.start()].decode("latin-1").splitlines()
    order, elements = _parse_header(path, lines)
    for element in elements:
        if element.count <= len(data):  # else it is cut short, which is reported below
            most = {"vertex": limits.VERTICES, "face": limits.TRIANGLES}.get(element.name, limits.TEXT_LINES)
            limits.require_at_most(path.name, f"rows of {element.name}", element.count, most, "decimate it")
        count, what = len(element.properties), f"properties of {element.name}"
        limits.require_at_most(path.name, what, count, limits.PROPERTIES, "export it again")
    if order is None:
        columns = _ascii_columns(path, number_lines(data, end.end(), path.name), elements)
    else:
        columns = _binary_columns(path, np.frombuffer(data, np.uint8, offset=end.end()), elements, order)
    found = (re.match(r"comment\s+TextureFile\s+(.+)", line, re.IGNORECASE) for line in lines)
    return _PlyFile(columns, tuple(match[1].strip() for match in found if match))


def _damaged(path: Path, what: str) -> ScanError:
    return ScanError(f"{path.name}: {what}; the file is damaged, truncated or no PLY: export it again")


def _parse_header(path: Path, lines: list[str]) -> tuple[str | None, list[_Element]]:
    """Return (byte order "<" or ">", None for ASCII; elements)."""
    orders = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
    order: str | None = "?"
    elements: list[_Element] = []
    for line in lines:
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = orders[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                elements[-1].properties.append(
                    _Property(words[4], np.dtype(_TYPES[words[3]]), np.dtype(_TYPES[words[2]]))
                )
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_Property(words[2], np.dtype(_TYPES[words[1]]), None))
        except (LookupError, ValueError) as error:
            raise _damaged(path, f"its header holds '{line.strip()[:60]}'") from error
    if order == "?" or any(element.count < 0 for element in elements):
        raise _damaged(path, "its header names no known format")
    for element in elements:
        names = {prop.name for prop in element.properties}
        if len(names) < max(len(element.properties), min(element.count, 1)):
            raise _damaged(path, f"its {element.name} has no properties, or one twice")
    return order, elements


def _ascii_columns(path: Path, lines: NumberLines, elements: list[_Element]) -> dict[str, Columns]:
    columns: dict[str, Columns] = {}
    row = 0
    for element in elements:
        rows = slice(row, row + element.count)
        row += element.count
        if len(lines.counts[rows]) < element.count:
            raise _damaged(path, f"it declares {element.count} {element.name} rows, but ends before that")
        table = lines.table(rows)
        if table.bad >= 0:
            raise _damaged(path, f"{element.name} {table.bad} is not made of numbers")
        columns[element.name] = _columns_of_table(path, element, table)
    return columns


def _columns_of_table(path: Path, element: _Element, table: NumberTable) -> Columns:
    """Split rows of numbers into properties; a list takes its count and its entries."""
    columns: Columns = {}
    column = np.zeros(element.count, np.int64)
    for prop in element.properties:
        if (column >= table.counts).any():
            raise _damaged(
                path, f"{element.name} {int(np.flatnonzero(column >= table.counts)[0])} is cut short"
            )
        values = table.values[table.first + column]
        column = column + 1
        if prop.count_type is None:
            columns[prop.name] = _converted(path, element, prop, values)
            continue
        if not ((values >= 0) & (column + values <= table.counts)).all():  # NaN is neither
            raise _damaged(path, f"a list {prop.name} of {element.name} is cut short")
        counts = values.astype(np.int64)
        items = table.ranges(column, counts)
        columns[prop.name] = _ListColumn(counts, _converted(path, element, prop, items))
        column = column + counts
    return columns


def _converted(path: Path, element: _Element, prop: _Property, values: FloatArray) -> NDArray[Any]:
    """Return numbers of a text file in the property's own type; raise for what an integer cannot hold."""
    if prop.item_type.kind in "iu":
        limits = np.iinfo(prop.item_type)
        fits = (values >= limits.min) & (values < float(limits.max) + 1)
        if not fits.all():
            wrong = f"{values[~fits][0]:g}, which {prop.item_type.name} cannot hold"
            raise _damaged(path, f"{prop.name} of {element.name} holds {wrong}")
    with np.errstate(over="ignore"):  # beyond float32 is infinite; infinite vertices in use raise later
        return values.astype(prop.item_type)


def _binary_columns(
    path: Path, body: NDArray[np.uint8], elements: list[_Element], order: str
) -> dict[str, Columns]:
    columns: dict[str, Columns] = {}
    position = 0
    for element in elements:
        result = _uniform_rows(body[position:], element, order)
        # A property of a row has a byte at least: a count beyond the file is not worth making room for.
        cells = element.count * len(element.properties)
        if result is None and cells <= len(body):
            what = f"properties of {element.name} with lists of several lengths"
            limits.require_at_most(path.name, what, cells, limits.TABLE_CELLS, "decimate it")
            result = _ragged_rows(body[position:], element, order)
        if result is None:
            raise _damaged(path, f"it declares {element.count} {element.name} rows, but ends before that")
        columns[element.name], size = result
        position += size
    return columns


def _uniform_rows(body: NDArray[np.uint8], element: _Element, order: str) -> tuple[Columns, int] | None:
    """Read rows of equal size in one view: no lists, or lists all as long as in the first row."""
    if element.count == 0:
        return _columns_of_rows(np.zeros(0, _row_type(element, order, {})), element), 0
    lengths: dict[str, int] = {}
    for prop in element.properties:
        if prop.count_type is not None:
            start = _row_type(element, order, lengths, before=prop.name).itemsize
            count_type = prop.count_type.newbyteorder(order)  # type: ignore[arg-type]
            if start + count_type.itemsize > len(body):
                return None
            lengths[prop.name] = int(body[start : start + count_type.itemsize].view(count_type)[0])
            if not 0 <= lengths[prop.name] * prop.item_type.itemsize <= len(body):
                return None
    row_type = _row_type(element, order, lengths)
    size = row_type.itemsize * element.count
    if size > len(body):
        return None
    rows = body[:size].view(row_type)
    if any((rows[f"#{name}"] != length).any() for name, length in lengths.items()):
        return None
    return _columns_of_rows(rows, element), size


def _row_type(
    element: _Element, order: str, lengths: dict[str, int], before: str | None = None
) -> np.dtype[Any]:
    fields: list[Any] = []
    for prop in element.properties:
        if prop.name == before:
            break
        item = prop.item_type.newbyteorder(order)  # type: ignore[arg-type]
        if prop.count_type is None:
            fields.append((prop.name, item))
        else:
            fields.append((f"#{prop.name}", prop.count_type.newbyteorder(order)))  # type: ignore[arg-type]
            fields.append((prop.name, item, (lengths.get(prop.name, 0),)))
    return np.dtype(fields)


def _columns_of_rows(rows: NDArray[Any], element: _Element) -> Columns:
    columns: Columns = {}
    for prop in element.properties:
        values = rows[prop.name].astype(prop.item_type)
        if prop.count_type is not None:
            counts = rows[f"#{prop.name}"].astype(np.int64)
            columns[prop.name] = _ListColumn(counts, values.reshape(-1))
        else:
            columns[prop.name] = values
    return columns


def _ragged_rows(body: NDArray[np.uint8], element: _Element, order: str) -> tuple[Columns, int] | None:
    """Read rows whose lists differ in length: walk once for the offsets, then gather by length."""
    items = np.array([prop.item_type.itemsize for prop in element.properties])
    counters = np.array([p.count_type.itemsize if p.count_type else 0 for p in element.properties])
    offsets, counts, size = walk_rows(body, element.count, items, counters, order == ">")
    if size < 0:
        return None
    columns: Columns = {}
    for i, prop in enumerate(element.properties):
        bytes_per_row = counts[:, i] * items[i]
        first = np.cumsum(bytes_per_row) - bytes_per_row
        source = np.arange(int(bytes_per_row.sum())) + np.repeat(offsets[:, i] - first, bytes_per_row)
        values = body[source].view(prop.item_type.newbyteorder(order))  # type: ignore[arg-type]
        values = values.astype(prop.item_type)
        columns[prop.name] = values if prop.count_type is None else _ListColumn(counts[:, i], values)
    return columns, size
