"""NPZ files with a header in JSON beside their arrays, read with errors that name the file and the fault."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.checked_json import checked_content
from scan2albedo.io.npz import Arrays, read_npz, write_npz

Header = TypeVar("Header", bound=BaseModel)


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
    content = {"header": np.array(header.model_dump_json()), **arrays}
    write_npz(path, content, what=what, compressed=False)


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
        found = read_npz(path, ("header", *arrays))
    except (OSError, ValueError) as cause:
        raise error(f"{what} {path} cannot be read ({cause}); give a file that {writer} wrote") from cause
    header = checked_content(
        str(found.pop("header")),
        kind,
        place=f"{what} {path}",
        whole="the header",
        advice=f"expected a header as in data_schemas/{schema}",
        error=error,
    )
    for name, array in found.items():
        if array.dtype.kind not in arrays[name]:
            raise error(f"{what} {path}: {name} holds {array.dtype}; write it again")
    return header, found
