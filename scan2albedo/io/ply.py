"""PLY scans with colours or textures; STL scans; OFF scans, ASCII, with vertex colours when they are COFF."""

import re
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scan2albedo.core.arrays import ByteArray, Float32Array, FloatArray, IntArray, NDArray, all_finite
from scan2albedo.errors import ScanError
from scan2albedo.geometry.operators import vertex_average
from scan2albedo.io import limits, parsed_mesh
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.parsed_mesh import GREY, Material, ParsedMesh, ScanFolder, ScanPictures, damaged
from scan2albedo.io.text_tables import NumberTable, filled_lines, number_table, plain_numbers, ranges

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
    elements, order = _declared(path, header, len(data))
    if order is None:
        columns = ascii_columns(path, number_table(filled_lines(data[end.end() :], path.name)), elements)
    else:
        columns, body = {}, np.frombuffer(data, np.uint8, offset=end.end())
        for element in elements:
            columns[element.name], size = _binary_rows(path, body, element, order)
            body = body[size:]
    return mesh_of_columns(path, folder, columns, _texture_files(header))


def _declared(path: Path, header: str, size: int) -> tuple[list[Element], str | None]:
    """Return the elements of a file of `size` bytes, and the byte order "<" or ">", None for text."""
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
        if element.count <= size:  # else it is cut short, which is reported below
            most = {"vertex": limits.VERTICES, "face": limits.TRIANGLES}.get(element.name, limits.TEXT_LINES)
            limits.require_at_most(path.name, f"rows of {element.name}", element.count, most, "decimate it")
        count, what = len(element.properties), f"properties of {element.name}"
        limits.require_at_most(path.name, what, count, limits.MATERIALS, "export it again")
    return elements, order


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
    uv = None
    listed = face.get("texcoord")
    of_vertices = next((names for names in _UV_NAMES if all(name in vertex for name in names)), None)
    if isinstance(listed, _ListColumn):
        uv = _uv_of_corners(listed, index.counts)[corners]
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
    named = [Material(name, None, GREY, texture_file=name) for name in texture_files]
    materials, notes = pictures.materials(named)
    materials, notes = pictures.or_named_like(path, uv, materials, notes)
    material = None
    if len(materials) > 1 and "texnumber" in of_face:
        chosen = of_face["texnumber"].astype(int)[polygon]
        material = np.where((chosen >= 0) & (chosen < len(materials)), chosen, -1)
    notes = parsed_mesh.cut_note(index.counts) + notes
    return ParsedMesh(vertices, faces, uv, material, materials, vertex_color_linear=colors, notes=notes)


def _uv_of_corners(listed: _ListColumn, counts: IntArray) -> FloatArray:
    """Return the coordinates (C, 2) of polygons' corners, NaN of those whose list has not two for each."""
    complete = listed.counts == 2 * counts
    uv = np.full((int(counts.sum()), 2), np.nan)
    uv[np.repeat(complete, counts)] = listed.items[np.repeat(complete, listed.counts)].reshape(-1, 2)
    return uv


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
    return folder.or_named_like(path, _texture_files(header))


def _texture_files(header: str) -> list[str]:
    found = (re.match(r"comment\s+TextureFile\s+(.+)", line, re.IGNORECASE) for line in header.splitlines())
    return [match[1].strip() for match in found if match]


def ascii_columns(path: Path, table: NumberTable, elements: list[Element]) -> dict[str, Columns]:
    """Split rows of numbers into properties; a list takes its count and its entries."""
    columns: dict[str, Columns] = {}
    row = 0
    for element in elements:
        counts = table.counts[row : row + element.count]
        first = table.first[row : row + element.count]
        row += element.count
        if len(counts) < element.count:
            if table.bad >= 0:
                raise damaged(path, f"{element.name} {len(counts)} is not made of numbers")
            raise _cut_short(path, element)
        found = columns[element.name] = {}
        column = np.zeros(element.count, int)
        for name, item_type, count_type in element.properties:
            if (short := np.flatnonzero(column >= counts)).size:
                raise damaged(path, f"{element.name} {short[0]} is cut short")
            values = table.values[first + column]
            column = column + 1
            listed = None
            if count_type is not None:
                if not ((values >= 0) & (column + values <= counts)).all():  # NaN is neither
                    raise damaged(path, f"a list {name} of {element.name} is cut short")
                listed = values.astype(int)
                values = table.values[ranges(first + column, listed)]
                column = column + listed
            if item_type.kind in "iu":
                bounds = np.iinfo(item_type)
                fits = (values >= bounds.min) & (values < float(bounds.max) + 1)
                if not fits.all():
                    wrong = f"{values[~fits][0]:g}, which {item_type.name} cannot hold"
                    raise damaged(path, f"{name} of {element.name} holds {wrong}")
            with np.errstate(over="ignore"):  # to infinity; infinite vertices in use raise later
                items = values.astype(item_type)
            found[name] = items if listed is None else _ListColumn(listed, items)
    return columns


def _cut_short(path: Path, element: Element) -> ScanError:
    return damaged(path, f"it declares {element.count} {element.name} rows, but ends before that")


def _binary_rows(path: Path, body: ByteArray, element: Element, order: str) -> tuple[Columns, int]:
    """Return (columns, bytes of all rows); ScanError where the body ends before."""
    total = element.count
    if total * len(element.properties) > len(body):  # a property of a row has a byte at least
        raise _cut_short(path, element)
    columns: Columns = {}
    # Lists have the length of the first row's, mostly: then the rows are those of a matrix of bytes.
    begins, counts, size = _cells(path, body, element, order, min(total, 1))
    even = 0 < total * size <= len(body)
    rows = body[: total * size if even else 0].reshape(-1, max(size, 1))
    for i, (_, _, count_type) in enumerate(element.properties):
        if even and count_type is not None:
            counters = rows[:, begins[0, i] - count_type.itemsize : begins[0, i]]
            even = bool((counters == counters[0]).all())
    if not even:
        begins, counts, size = _cells(path, body, element, order, total)
    for i, (name, item_type, count_type) in enumerate(element.properties):
        widths = counts[:, i] * item_type.itemsize
        if even:
            stored = rows[:, begins[0, i] : begins[0, i] + widths[0]].ravel()
        else:
            stored = body[ranges(begins[:, i], widths)]
        values = stored.view(item_type.newbyteorder(order)).astype(item_type)  # type: ignore[arg-type]
        listed = np.broadcast_to(counts[:, i], total)
        columns[name] = values if count_type is None else _ListColumn(listed, values)
    return columns, size * total if even else size


def _cells(
    path: Path, body: ByteArray, element: Element, order: str, rows: int
) -> tuple[IntArray, IntArray, int]:
    """Walk over the first binary rows: where in `body` each property begins (R, P), how many items it has
    (R, P), and the bytes of these rows."""
    width = len(element.properties)
    what = f"properties of {element.name} in all its rows"
    limits.require_at_most(path.name, what, rows * width, 2 * limits.TRIANGLES, "decimate it")
    data = body.data
    begins = array("q")
    counts = array("q")
    place = 0
    sizes = [(item.itemsize, counter.itemsize if counter else 0) for _, item, counter in element.properties]
    for item, counter in sizes * rows:
        count = 1
        if counter:
            count = int.from_bytes(data[place : place + counter], "big" if order == ">" else "little")
        place += counter
        begins.append(place)
        counts.append(count)
        place += count * item
        if place > len(data):
            raise _cut_short(path, element)
    return np.reshape(begins, (-1, width)), np.reshape(counts, (-1, width)), place


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
        limits.require_at_most(path.name, "lines", data.count(b"\n"), limits.TEXT_LINES, "decimate it")
        # Names may be of any words; several vertices may stand on a line.
        words = plain_numbers(re.sub(rb"solid[^\r\n]*", b"", data.lower()))
        lines = re.findall(rb"vertex([ \t]+\S+[ \t]+\S+[ \t]+\S+)", words)
        if len(lines) != words.count(b"vertex"):
            raise damaged(path, "a vertex has not three numbers")
        table = number_table(b"\n".join([*lines, b""]))
        if table.bad >= 0:
            raise damaged(path, f"vertex {table.bad} is not made of numbers")
        corners = table.values.reshape(-1, 3)
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
    head, _, rows = filled_lines(data[header.end() :], path.name).partition(b"\n")
    counts = number_table(head + b"\n").values[:2]
    table = number_table(rows)
    if len(counts) < 2 or not ((counts >= 0) & (counts < limits.TEXT_LINES)).all():  # or NaN
        raise damaged(path, "its counts are not numbers that a file has")
    names, number = ["x", "y", "z"], np.dtype(np.float64)
    vertex, face = (Element(name, int(n)) for name, n in zip(("vertex", "face"), counts, strict=True))
    plain = bool(header[2]) and not (header[1] or header[3])  # colours without normals or coordinates
    if plain and table.counts[: vertex.count].min(initial=9) >= 6:
        names += ["red", "green", "blue"]
    vertex.properties += [(name, number, None) for name in names]
    face.properties.append(("vertex_indices", np.dtype(np.int64), number))
    return mesh_of_columns(path, folder, ascii_columns(path, table, [vertex, face]), [])
