"""STL files, binary or as text, and ASCII OFF files, with vertex colours when they are COFF."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scan2albedo.io import limits
from scan2albedo.io.obj import ObjLines
from scan2albedo.io.parsed_mesh import ParsedMesh, damaged
from scan2albedo.io.ply import Element, ascii_columns, mesh_of_columns
from scan2albedo.io.scan_folder import ScanFolder
from scan2albedo.io.text_tables import NumberLines, number_lines

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
            corners = np.ndarray(declared, triangle, data, 84)["corners"].astype(np.float64)
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
