"""STL files, through trimesh, and ASCII OFF files, with vertex colours when they are COFF.

Undamaged text STL files of one solid are read here, in a quarter of trimesh's time. OFF is read here since
trimesh leaves out vertex colours and damaged faces without a word.
"""

from __future__ import annotations

import re
import warnings
from io import BytesIO, StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import IntArray
from scan2albedo.errors import ScanError
from scan2albedo.io import limits
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.parsed_mesh import ParsedMesh, cut_note, fan_triangles
from scan2albedo.io.text_tables import (
    NumberTable,
    line_ranges,
    number_lines,
    parse_float_lines,
    split_keywords,
)

_HEADER = re.compile(rb"^(?:\s*#[^\n]*\n)*\s*(ST)?(C)?(N)?OFF(?:[ \t]+BINARY)?")

_STL_HEADER_BYTES, _STL_TRIANGLE_BYTES = 84, 50
_VERTEX = b"vertex"
_LARGEST_INDEX = 2.0**53
"""Beyond it a float64 does not hold every whole number; such an index, or NaN, points nowhere."""


def read_stl(path: Path) -> ParsedMesh:
    """Read a binary or ASCII STL file. Raises ScanError, naming it, when it is damaged, cut or empty."""
    from trimesh.exchange.stl import load_stl_ascii, load_stl_binary

    data = limits.read_bytes(path, advice="decimate it")
    declared = int.from_bytes(data[80:84], "little")
    needed = _STL_HEADER_BYTES + _STL_TRIANGLE_BYTES * declared
    try:
        if len(data) == needed:
            limits.require_at_most(path.name, "triangles", declared, limits.TRIANGLES, "decimate it")
            loaded = load_stl_binary(BytesIO(data))
        elif b"endsolid" in data[-4096:].lower() and b"\0" not in data[:512]:
            limits.require_at_most(path.name, "lines", data.count(b"\n"), limits.TEXT_LINES, "decimate it")
            if (corners := _undamaged_corners(data)) is not None:
                return ParsedMesh(corners, np.arange(len(corners)).reshape(-1, 3))
            advice = "save it as binary STL"
            limits.require_at_most(path.name, "bytes", len(data), limits.SLOW_TEXT_BYTES, advice)
            with warnings.catch_warnings():
                warnings.simplefilter("error", DeprecationWarning)  # of text that is not numbers
                loaded = load_stl_ascii(StringIO(data.decode("utf-8", "replace")))
        else:
            what = f"it has {len(data)} bytes, but {declared} triangles need {needed}"
            raise _damaged(path, f"{what}, and it does not end with endsolid", "STL")
    except (ValueError, LookupError, DeprecationWarning) as error:
        raise _damaged(path, str(error), "STL") from error
    solids = list(loaded["geometry"].values()) if "geometry" in loaded else [loaded]
    if not solids:
        raise _damaged(path, "it holds no triangles", "STL")
    corners = np.concatenate([solid["vertices"] for solid in solids]).astype(np.float64)
    return ParsedMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def _undamaged_corners(data: bytes) -> NDArray[np.float64] | None:
    """Return the corners (3F, 3) of one undamaged solid, each vertex on its own line; else None."""
    words = data.lower()
    if not words.startswith(b"solid") or words.count(b"endsolid") != 1 or b"#" in words:
        return None
    text = np.frombuffer(words, np.uint8)
    starts, ends = line_ranges(text)
    _, bodies = split_keywords(text, starts, ends)
    first_words = text[bodies[:, None] + np.arange(-len(_VERTEX), 0)]
    rows = np.flatnonzero((first_words == np.frombuffer(_VERTEX, np.uint8)).all(axis=1))
    if len(rows) != words.count(_VERTEX) or len(rows) % 3 or words.rfind(_VERTEX) > words.find(b"endsolid"):
        return None
    corners, read = parse_float_lines(text, bodies[rows], ends[rows], 3)
    whole = len(rows) > 0 and (read == 3).all() and np.isfinite(corners).all()
    return corners if whole else None


def read_off(path: Path) -> ParsedMesh:
    """Read an ASCII OFF file. Raises ScanError, naming it, when it is damaged, binary or cut short."""
    data = limits.read_bytes(path, advice="decimate it")
    header = _HEADER.match(data)
    if header is None or header[0].endswith(b"BINARY"):
        raise _damaged(
            path, "it does not begin with OFF" if header is None else "binary OFF is not supported"
        )
    lines = number_lines(data, header.end(), path.name)
    head = lines.table(slice(1))
    if len(head.counts) == 0 or head.counts[0] < 2 or head.bad >= 0:
        raise _damaged(path, "a line is not made of numbers")
    if not np.isfinite(head.values[:2]).all():
        raise _damaged(path, "its counts are not numbers")
    vertex_count, face_count = int(head.values[0]), int(head.values[1])
    if vertex_count < 0 or face_count < 0 or len(lines.counts) < 1 + vertex_count + face_count:
        raise _damaged(
            path, f"it declares {vertex_count} vertices and {face_count} faces, but ends before that"
        )
    limits.require_at_most(path.name, "vertices", vertex_count, limits.VERTICES, "decimate it")
    vertices = lines.table(slice(1, 1 + vertex_count))
    rows = lines.table(slice(1 + vertex_count, 1 + vertex_count + face_count))
    if vertices.bad >= 0 or rows.bad >= 0:
        raise _damaged(path, "a line is not made of numbers")
    if vertex_count and vertices.counts.min() < 3:
        raise _damaged(path, "a vertex has fewer than 3 coordinates")
    faces, notes = _faces(path, rows)
    xyz, colors = vertices.values[vertices.first[:, None] + np.arange(3)], None
    declared = bool(header[2]) and not (header[1] or header[3])
    if declared and vertex_count and vertices.counts.min() >= 6:
        srgb = vertices.values[vertices.first[:, None] + np.arange(3, 6)]
        colors = linear_of_srgb_numbers(srgb) if np.isfinite(srgb).all() else None
    return ParsedMesh(xyz, faces, vertex_color_linear=colors, notes=notes)


def _damaged(path: Path, what: str, kind: str = "ASCII OFF") -> ScanError:
    return ScanError(f"{path.name}: {what}; the file is damaged, truncated or no {kind}: export it again")


def _faces(path: Path, rows: NumberTable) -> tuple[IntArray, tuple[str, ...]]:
    if len(rows.counts) == 0:
        return np.zeros((0, 3), np.int64), ()
    declared = rows.values[rows.first]
    if not ((declared >= 3) & (declared + 1 <= rows.counts)).all():  # NaN is neither
        raise _damaged(path, "a face has fewer than 3 corners, or fewer than it declares")
    counts = declared.astype(np.int64)
    triangles = int(counts.sum()) - 2 * len(counts)
    limits.require_at_most(path.name, "triangles", triangles, limits.TRIANGLES, "decimate it")
    corners = rows.ranges(np.ones(len(counts), np.int64), counts)
    index = np.where(np.abs(corners) < _LARGEST_INDEX, corners, -1).astype(np.int64)
    return index[fan_triangles(counts).corners], cut_note(counts)
