"""NPZ files with a header in JSON beside their arrays, read with errors that name the file and the fault."""

from __future__ import annotations

import io
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.atomic import atomic_path

Header = TypeVar("Header", bound=BaseModel)
Arrays = dict[str, NDArray[Any]]

_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    TypeError,
    SyntaxError,
    RuntimeError,  # NotImplementedError is one
    MemoryError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    tokenize.TokenError,
)
"""What zip, NumPy's header and its parser raise of bytes that are not what was written."""


def write_checked_npz(
    path: str | Path, header: BaseModel, arrays: Mapping[str, NDArray[Any]], *, what: str
) -> None:
    """Write a header and arrays as an .npz file, whole or not at all; same content, same bytes.

    Raises
    ------
    ValueError
        When the name does not end in .npz; `what` is written, in words.
    OutputError
        When the file cannot be written.
    """
    if Path(path).suffix != ".npz":
        raise ValueError(f"{what}s are written as .npz, got {Path(path).name}")
    content: Arrays = {"header": np.array(header.model_dump_json()), **arrays}
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **content)


def read_checked_npz(
    path: str | Path,
    kind: type[Header],
    arrays: Mapping[str, str],
    *,
    what: str,
    writer: str,
    schema: str,
    error: type[Scan2AlbedoError],
) -> tuple[Header, Arrays]:
    """Return header and arrays of a file.

    Parameters
    ----------
    path : str or Path
    kind : type of BaseModel
        Of the header.
    arrays : mapping of str to str
        Names of the arrays, and the letters of the kinds of dtype they may have; others are not read.
    what : str
        The thing in the file, for messages, such as "reflectance model".
    writer : str
        Function that writes such files.
    schema : str
        File in data_schemas.
    error : type of Scan2AlbedoError
        To raise.

    Raises
    ------
    Scan2AlbedoError
        Of the given type, when the file is missing, damaged or something else.
    """
    try:
        with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as file:
            found = {name: file[name] for name in ("header", *arrays)}
    except _DAMAGE as cause:
        raise error(
            f"{what} {path} cannot be read ({' '.join(str(cause).split())}); give a file that {writer} wrote"
        ) from cause
    try:
        header = kind.model_validate_json(str(found.pop("header")))
    except ValidationError as cause:
        first = cause.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the header"
        raise error(
            f"{what} {path}: {where}: {first['msg']} ({cause.error_count()} problems); expected a header as "
            f"in data_schemas/{schema}"
        ) from cause
    for name, array in found.items():
        if array.dtype.kind not in arrays[name]:
            raise error(f"{what} {path}: {name} holds {array.dtype}; write it again")
    return header, found
