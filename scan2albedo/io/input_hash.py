"""One hash for a scan and everything it refers to: when it changes, results are stale."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

from scan2albedo.errors import ScanError, TooLargeError
from scan2albedo.io import limits
from scan2albedo.io.images import SUPPORTED_IMAGES
from scan2albedo.io.limits import parse_json
from scan2albedo.io.mtl import MaterialText, decoded, parse_mtl
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
        for field in ("vertices", "faces", "uv", "texture_linear", "vertex_color_linear"):
            value = getattr(source, field)
            digest.update(f"{field}:{None if value is None else (value.shape, value.dtype.str)};".encode())
            if value is not None:
                digest.update(value.tobytes())
        return digest.hexdigest()
    try:
        limits.require_regular(Path(source))
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
    referred = {".obj": _of_obj, ".ply": _of_ply, ".gltf": _of_gltf}.get(path.suffix.lower())
    folder = ScanFolder(path.parent, None if textures is None else Path(textures))
    # A pipe or a device may never end.
    try:
        names = referred(path, folder) if referred and path.is_file() else []
    except TooLargeError:
        names = []  # load_scan says so
    found = [folder.find(name) for name in names]
    return (path, *dict.fromkeys(file for file in found if file is not None))


def _of_obj(path: Path, folder: ScanFolder) -> list[str]:
    names: list[str] = []
    materials: dict[str, MaterialText] = {}
    for match in re.findall(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", limits.read_bytes(path), re.MULTILINE):
        for library in folder.library_names(decoded(match).strip()):
            names.append(library)
            file = folder.find(library)
            data = b"" if file is None else limits.read_bytes(file, limits.LIBRARY_BYTES)
            materials |= parse_mtl(decoded(data))
    textures = [m.texture_file for m in materials.values() if m.texture_file is not None]
    if all(folder.find(name) is None for name in textures):
        names += [path.stem + extension for extension in SUPPORTED_IMAGES]  # load_scan takes one of these
    return names + textures


def _of_ply(path: Path, folder: ScanFolder) -> list[str]:
    with path.open("rb") as file:
        header = file.read(1 << 16).split(b"end_header", maxsplit=1)[0].decode("latin-1")
    names = re.findall(r"^comment\s+TextureFile\s+(.+?)\s*$", header, re.MULTILINE | re.IGNORECASE)
    if all(folder.find(name) is None for name in names):
        names += [path.stem + extension for extension in SUPPORTED_IMAGES]  # load_scan takes one of these
    return names


def _of_gltf(path: Path, folder: ScanFolder) -> list[str]:
    try:
        tree = parse_json(path.name, limits.read_bytes(path))
        entries = [*tree.get("buffers", ()), *tree.get("images", ())]
        uris = [entry.get("uri", "") for entry in entries]
    except (ValueError, AttributeError, TypeError, RecursionError):
        return []  # load_scan says what is wrong with the file
    return [unquote(uri) for uri in uris if uri and not uri.startswith("data:")]
