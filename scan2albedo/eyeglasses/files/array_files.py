"""NPZ files of arrays whose shapes fit together, read with errors that name the file."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import EyeglassesError
from scan2albedo.io.atomic import atomic_path

Shapes = Mapping[str, tuple[int | str, ...]]
"""Shapes of arrays by name; a letter stands for a length that is one wherever the letter is."""


def write_arrays(path: str | Path, source: Any, names: Shapes) -> None:
    """Write the attributes of `source` that `names` has, atomically.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    """
    with atomic_path(path) as temporary:
        arrays: dict[str, Any] = {name: np.asarray(getattr(source, name)) for name in names}
        np.savez_compressed(temporary, **arrays)


def read_arrays(path: str | Path, shapes: Shapes, *, what: str, example: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file.

    Parameters
    ----------
    path : str or Path
    shapes : mapping of str to tuple
        Of all arrays that must be there. Those of "vertices" and "faces" make a mesh.
    what : str
        The thing in the file, for messages, such as "canonical frame".
    example : str
        The usual name of such a file.

    Raises
    ------
    EyeglassesError
        When the file is missing, damaged or something else; names it.
    """
    try:
        with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in shapes}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, TypeError) as error:
        raise EyeglassesError(
            f"{what} {path} cannot be read ({' '.join(str(error).split())}); give a {example}"
        ) from error
    lengths: dict[str, int] = {}
    for name, shape in shapes.items():
        got = arrays[name].shape
        wanted = tuple(
            lengths.setdefault(side, got[k]) if isinstance(side, str) and k < len(got) else side
            for k, side in enumerate(shape)
        )
        if got != wanted or arrays[name].dtype.kind not in "biuf":
            raise EyeglassesError(
                f"{what} {path}: {name} has shape {got} of {arrays[name].dtype}, expected numbers of shape "
                f"({', '.join(map(str, wanted))}); write it again"
            )
    _check_mesh(arrays["vertices"], arrays["faces"], f"{what} {path}")
    return arrays


def _check_mesh(vertices: NDArray[Any], faces: NDArray[Any], place: str) -> None:
    if not np.isfinite(vertices).all():
        raise EyeglassesError(f"{place}: vertices are not finite; write it again")
    if faces.dtype.kind not in "iu" or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise EyeglassesError(f"{place}: faces are not those of its vertices; write it again")
