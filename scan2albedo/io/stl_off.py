"""STL files, binary or as text, and ASCII OFF files, with vertex colours when they are COFF."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scan2albedo.io import limits
from scan2albedo.io import text_tables as tables
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.parsed_mesh import ParsedMesh, cut_note, damaged, fan_triangles, require_few_triangles
from scan2albedo.io.scan_folder import ScanFolder

_HEADER = re.compile(rb"^(?:\s*#[^\n]*\n)*\s*(ST)?(C)?(N)?OFF(?:[ \t]+BINARY)?")


def read_stl(path: Path, _folder: ScanFolder) -> ParsedMesh:
    """Read a binary or ASCII STL file. Raises ScanError, naming it, when it is damaged, cut or empty."""
    data = limits.read_bytes(path, advice="decimate it")
    declared = int.from_bytes(data[80:84], "little")
    needed = 84 + 50 * declared
    if len(data) == needed:
        limits.require_at_most(path.name, "triangles", declared, limits.TRIANGLES, "decimate it")
        triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.ndarray(declared, triangle, data, 84)["corners"].astype(np.float64)
    elif b"endsolid" in data[-4096:].lower() and b"\0" not in data[:512]:
        words = data.lower()
        if re.search(rb"^[ \t]*vertex\s", words, re.MULTILINE) is None:  # several on a line
            words = words.replace(b"vertex", b"\nvertex")
        limits.require_at_most(path.name, "lines", words.count(b"\n"), limits.TEXT_LINES, "decimate it")
        text = np.frombuffer(words, np.uint8)
        starts, ends = tables.line_ranges(text)
        kinds, starts = tables.split_keywords(text, starts, ends)
        of_vertices = kinds == tables.keyword(b"vertex")
        starts, ends = starts[of_vertices], ends[of_vertices]
        counts = tables.count_tokens(text, starts, ends)
        table = tables.NumberLines(text, starts, ends, counts).table(most=3)
        if table.bad >= 0 or (counts < 3).any() or len(counts) % 3:
            raise damaged(path, "a vertex has not three numbers, or a triangle not three vertices", "STL")
        corners = table.values
    else:
        what = f"it has {len(data)} bytes, but {declared} triangles need {needed}"
        raise damaged(path, f"{what}, and it does not end with endsolid", "STL")
    if corners.size == 0:
        raise damaged(path, "it holds no triangles", "STL")
    return ParsedMesh(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))


def read_off(path: Path, _folder: ScanFolder) -> ParsedMesh:
    """Read an ASCII OFF file. Raises ScanError, naming it, when it is damaged, binary or cut short."""
    data = limits.read_bytes(path, advice="decimate it")
    header = _HEADER.match(data)
    kind = "ASCII OFF"
    if header is None:
        raise damaged(path, "it does not begin with OFF", kind)
    if header[0].endswith(b"BINARY"):
        raise damaged(path, "binary OFF is not supported", kind)
    lines = tables.number_lines(data, header.end(), path.name)
    head = lines.table(slice(1))
    if len(head.counts) == 0 or head.counts[0] < 2 or head.bad >= 0:
        raise damaged(path, "a line is not made of numbers", kind)
    if not np.isfinite(head.values[:2]).all():
        raise damaged(path, "its counts are not numbers", kind)
    vertex_count, face_count = int(head.values[0]), int(head.values[1])
    if vertex_count < 0 or face_count < 0 or len(lines.counts) < 1 + vertex_count + face_count:
        declared = f"it declares {vertex_count} vertices and {face_count} faces, but ends before that"
        raise damaged(path, declared, kind)
    limits.require_at_most(path.name, "vertices", vertex_count, limits.VERTICES, "decimate it")
    vertices = lines.table(slice(1, 1 + vertex_count))
    rows = lines.table(slice(1 + vertex_count, 1 + vertex_count + face_count))
    if vertices.bad >= 0 or rows.bad >= 0:
        raise damaged(path, "a line is not made of numbers", kind)
    if vertex_count and vertices.counts.min() < 3:
        raise damaged(path, "a vertex has fewer than 3 coordinates", kind)
    sizes = rows.values[rows.first]
    if not ((sizes >= 3) & (sizes + 1 <= rows.counts)).all():  # NaN is neither
        raise damaged(path, "a face has fewer than 3 corners, or fewer than it declares", kind)
    counts = sizes.astype(np.int64)
    require_few_triangles(path.name, counts)
    corners = rows.ranges(np.ones(len(counts), np.int64), counts)
    # Beyond 2^53 a float does not hold every whole number; such an index, or NaN, points nowhere.
    index = np.where(np.abs(corners) < 2**53, corners, -1).astype(np.int64)
    colors = None
    declared_colors = bool(header[2]) and not (header[1] or header[3])
    if declared_colors and vertex_count and vertices.counts.min() >= 6:
        srgb = vertices.columns(3, 6)
        colors = linear_of_srgb_numbers(srgb) if np.isfinite(srgb).all() else None
    return ParsedMesh(
        vertices.columns(0, 3),
        index[fan_triangles(counts)[0]],
        vertex_color_linear=colors,
        notes=cut_note(counts),
    )
