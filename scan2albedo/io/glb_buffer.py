"""The parts of a binary glTF file: a buffer with accessors into it, and the container."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

VERTEX_DATA, INDICES = 34962, 34963
"""What a buffer view is for, in the standard's numbers."""
_COMPONENT = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}


class GlbBuffer:
    """The binary chunk of a file and the accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], kind: str, target: int | None = None, *, bounds: bool = False) -> int:
        """Append an array, one element a row, and return the number of its accessor."""
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": little.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += little.tobytes() + b"\0" * (-little.nbytes % 4)
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _COMPONENT[array.dtype.str[1:]],
            "count": len(array),
            "type": kind,
        }
        if bounds:
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def entries(self) -> dict[str, Any]:
        """Return the top-level entries that describe the chunk."""
        buffers = [{"byteLength": len(self.data)}]
        return {"accessors": self.accessors, "bufferViews": self.views, "buffers": buffers}


def glb_bytes(tree: dict[str, Any], data: bytes) -> bytes:
    """Return a GLB of two chunks: JSON filled up with blanks, and the buffer."""
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
