"""SHA-256 of what results are made from, by which a result that still holds is told from an old one."""

import hashlib
import math
from contextlib import suppress
from pathlib import Path

from scan2albedo.core import RawScan
from scan2albedo.errors import ScanError, TooLargeError
from scan2albedo.io import limits
from scan2albedo.io.load_scan import files_of_scan


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
        files: tuple[Path, ...] = (Path(source),)
        with suppress(TooLargeError):  # load_scan says so
            files = files_of_scan(files[0], textures)
        for file in files:
            digest.update(f"{file.stat().st_size}:".encode())
            with file.open("rb") as opened:
                hashlib.file_digest(opened, lambda: digest)
    except OSError as error:
        raise ScanError(f"{source}: cannot be read: {error.strerror or error}; check the path") from error
    return digest.hexdigest()


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of one file; raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
