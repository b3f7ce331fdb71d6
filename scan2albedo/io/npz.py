"""NPZ files: written whole or not at all, and read with two kinds of error for all that can be wrong."""

from __future__ import annotations

import struct
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from scan2albedo.io.atomic import atomic_path

Arrays = dict[str, NDArray[Any]]

_DAMAGE = (
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


def write_npz(path: str | Path, arrays: Mapping[str, NDArray[Any]], *, what: str, compressed: bool) -> None:
    """Write arrays as an .npz file, whole or not at all; same content, same bytes.

    Parameters
    ----------
    path : str or Path
    arrays : mapping of str to array
        By the names they get in the file.
    what : str
        The thing that is written, for messages, such as "reflectance model".
    compressed : bool
        Worth its time where values repeat: masks and indices do, bits of measured floats do not.

    Raises
    ------
    ValueError
        When the name does not end in .npz.
    OutputError
        When the file cannot be written.
    """
    if Path(path).suffix != ".npz":
        raise ValueError(f"{what}s are written as .npz, got {Path(path).name}")
    content: dict[str, Any] = dict(arrays)
    save = np.savez_compressed if compressed else np.savez
    with atomic_path(path) as temporary:
        save(temporary, allow_pickle=False, **content)


def read_npz(path: str | Path, names: Collection[str] | None = None) -> Arrays:
    """Return arrays of an .npz file by name.

    Parameters
    ----------
    path : str or Path
    names : collection of str, optional
        Of the arrays that must be there, others are not read; all when omitted.

    Raises
    ------
    OSError
        When the file cannot be opened.
    ValueError
        When it is damaged, something else, or lacks an array; tells what it met, not the file.
    """
    # A stream of our own: NumPy leaves the file open where it is damaged.
    with Path(path).open("rb") as stream:
        try:
            stored = np.load(stream, allow_pickle=False)
            if not isinstance(stored, NpzFile):
                raise ValueError("it holds a single array, no archive of them")
            with stored:
                return {name: stored[name] for name in (stored.files if names is None else names)}
        except _DAMAGE as cause:
            raise ValueError(" ".join(str(cause).split())) from cause
