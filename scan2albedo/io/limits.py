"""How much of a file is read; what declares or holds more is refused before any work.

Within these limits a scan is read in about 2 GB of memory and 20 seconds. What a scan needs lies far below: a
head of 0.1 mm resolution has five million triangles, and a geometry image of it at most 16384 x 16384 texels.
"""

import json
import re
import stat
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

from scan2albedo.errors import ScanError, TooLargeError

FILE_BYTES = 1 << 29
"""Of a scan, a picture, or a binary buffer that a scan refers to."""
TEXT_LINES = 1 << 24
"""Of a mesh written as text."""
VERTICES = 1 << 23
"""Of all instances together."""
TRIANGLES = VERTICES
"""Of all instances together, and of what polygons are cut into."""
PIXELS = 1 << 26
"""Of a picture, and of all pictures of a scan together: 8192 x 8192, each of at most three 32-bit floats."""
LIBRARY_BYTES = 1 << 24
"""Of the MTL files of a scan together, where a material takes some 200 bytes."""
TABLE_BYTES = 1 << 26
"""Of a list or table that a person wrote: a million paths."""
NAME_BYTES = 1 << 12
"""Of the name of a material or file, with its options: paths are shorter."""
VALUES = 1 << 22
"""Of the JSON of a glTF file, and lines of an OBJ file that name a material: each becomes a Python object."""
MATERIALS = 1 << 10
"""Of a scan, which are laid side by side in one texture; also the properties of an element of a PLY file."""
NODES = 1 << 12
"""Of a glTF scene, each counted as often as it is reached; also of the parts that all its meshes have."""
GROWTH = 16
"""Arrays and EXR pictures of more bytes than that are read from files that are large themselves: masks shrink
more, measured numbers less. What a file of zeros declares may be a thousand times its size."""

_FOREIGN = {
    rb"version https://git-lfs": "a Git LFS pointer in its place: fetch the file itself (git lfs pull)",
    rb"<!doctype html|<html": "a web page: download the file itself",
    rb"pk\x03\x04|\x1f\x8b\x08|7z\xbc\xaf|rar!": "an archive: unpack it",
    rb"#vrml": "a VRML scene: export the scan as OBJ, PLY or GLB",
}
"""Beginnings, in lower case, of files that are no scan's, whatever their names end with."""

DAMAGE = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    NameError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What parsers, NumPy's and trimesh's among them, raise of bytes that are not what was written."""


def require_at_most(name: str, what: str, count: float, limit: float, advice: str) -> None:
    """Raise TooLargeError, naming the file, when `count` of something is above its limit."""
    if count > limit:
        raise TooLargeError(f"{name}: {count:,} {what} are more than the {limit:,} that are read; {advice}")


def parse_json(name: str, text: bytes) -> Any:
    """Return what JSON text holds; raises ValueError, RecursionError, TooLargeError for too many values."""
    # Text inside quotes counts too, but no more than its commas and brackets: base64 has none.
    values = 1 + text.count(b",") + text.count(b"[") + text.count(b"{")
    require_at_most(name, "JSON values", values, VALUES, "decimate or simplify the scene")
    return json.loads(text.decode("utf-8", "replace"))


def require_file(file: Path, limit: float = FILE_BYTES, advice: str = "make it smaller") -> int:
    """Return the bytes of a file; TooLargeError above `limit`, OSError if missing, ScanError for a pipe."""
    status = file.stat()
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise ScanError(f"{file}: is a pipe or a device, not a file; give a file")
    require_at_most(file.name, "bytes", status.st_size, limit, advice)
    return status.st_size


def require_own_kind(file: Path) -> None:
    """Raise ScanError for a file whose beginning says that it is none of a scan; OSError if missing."""
    with file.open("rb") as opened:
        beginning = opened.read(1024).lstrip().lower()
    for beginnings, what in _FOREIGN.items():
        if re.match(beginnings, beginning):
            raise ScanError(f"{file.name}: is {what}")


def read_bytes(file: Path, limit: int = FILE_BYTES, advice: str = "make it smaller") -> bytes:
    """Return the content of a scan's file; raises as `require_file` and `require_own_kind` do."""
    require_file(file, limit, advice)
    require_own_kind(file)
    return file.read_bytes()
