"""One hash for a scan and everything it refers to: when it changes, results are stale."""

from __future__ import annotations

import hashlib
import math
from contextlib import suppress
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from scan2albedo.errors import ScanError, TooLargeError
from scan2albedo.io import limits
from scan2albedo.io.load_scan import READERS
from scan2albedo.io.scan_folder import ScanFolder

if TYPE_CHECKING:
    from scan2albedo.core.raw_scan import RawScan


def input_sha256(source: str | Path | RawScan, textures: str | Path | None = None) -> str:
    """Return the SHA-256 of a scan file with its material libraries and textures, or of a `RawScan`'s arrays.

    `textures` is the folder that `load_scan` may also read from. Take it when the file is read: the file may
    change before results are written. Raises ScanError when the file cannot be read.
    """
    digest = hashlib.sha256()
    if not isinstance(source, str | Path):
        for field in ("vertices", "faces", "uv", "texture_linear", "vertex_color_linear", "color_seen"):
            value = getattr(source, field)
            digest.update(f"{field}:{None if value is None else (value.shape, value.dtype.str)};".encode())
            if value is not None:
                digest.update(value.tobytes())
        return digest.hexdigest()
    try:
        limits.require_file(Path(source), math.inf)
        for file in files_of_scan(Path(source), textures):
            digest.update(f"{file.stat().st_size}:".encode())
            with file.open("rb") as opened:
                while block := opened.read(1 << 20):
                    digest.update(block)
    except OSError as error:
        raise ScanError(f"{source}: cannot be read: {error.strerror or error}; check the path") from error
    return digest.hexdigest()


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of one file; raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_of_scan(path: Path, textures: str | Path | None = None) -> tuple[Path, ...]:
    """Return the scan file and the existing files it refers to: material libraries, textures, buffers."""
    _, reader = READERS.get(path.suffix.lower(), ("", ""))
    folder = ScanFolder(path.parent, None if textures is None else Path(textures))
    names: list[str] = []
    if reader and path.is_file():  # a pipe or a device may never end
        with suppress(TooLargeError):  # load_scan says so
            names = resolve_name(reader)(path, folder)
    found = map(folder.find, names)
    return (path, *dict.fromkeys(file for file in found if file is not None))
