"""STL files, binary or ASCII: triangles without colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ScanError
from scan2albedo.io.parsed_mesh import ParsedMesh

_HEADER_BYTES = 84
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path) -> ParsedMesh:
    """Read an STL file; it is binary when its length is what a binary header declares.

    Raises
    ------
    ScanError
        When the file is damaged or cut short; the message names it.
    """
    data = path.read_bytes()
    declared = int(np.frombuffer(data[80:84], "<u4")[0]) if len(data) >= _HEADER_BYTES else -1
    needed = _HEADER_BYTES + declared * _TRIANGLE.itemsize
    if len(data) == needed:
        corners = np.frombuffer(data, _TRIANGLE, offset=_HEADER_BYTES)["corners"].astype(np.float64)
        return _mesh(corners.reshape(-1, 3))
    if data[:512].lstrip()[:5].lower() == b"solid" and b"\0" not in data[:512]:
        return _mesh(_ascii_corners(path, data))
    raise _damaged(path, f"it has {len(data)} bytes, but {declared} triangles need {needed}")


def _damaged(path: Path, what: str) -> ScanError:
    return ScanError(f"{path.name}: {what}; the file is damaged, truncated or no STL: export it again")


def _mesh(corners: NDArray[np.float64]) -> ParsedMesh:
    return ParsedMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def _ascii_corners(path: Path, data: bytes) -> NDArray[np.float64]:
    from scan2albedo.io import text_tables as tables

    text = np.frombuffer(data, np.uint8)
    starts, ends = tables.line_ranges(text)
    kinds, bodies = tables.split_keywords(text, starts, ends)
    rows = np.flatnonzero(kinds == tables.STL_VERTEX)
    corners, read = tables.parse_float_lines(text, bodies[rows], ends[rows], 3)
    if (read != 3).any():
        raise _damaged(path, f"line {rows[read != 3][0] + 1} is no vertex of 3 numbers")
    if len(corners) % 3 or b"endsolid" not in data[-4096:].lower():
        raise _damaged(path, f"it ends after {len(corners)} vertices without endsolid")
    return corners
