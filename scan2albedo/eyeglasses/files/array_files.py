"""NPZ files of arrays whose shapes fit together, read with errors that name the file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import EyeglassesError
from scan2albedo.io.npz import read_npz, write_npz

Layout = Mapping[str, tuple[type, *tuple[int | str, ...]]]
"""Type and shape of arrays by name; a letter stands for a length that is one wherever the letter is."""


def write_arrays(path: str | Path, source: Any, layout: Layout, *, what: str) -> None:
    """Write the attributes of `source` that `layout` names, whole or not at all.

    Raises
    ------
    ValueError
        When the name does not end in .npz; `what` is written, in words.
    OutputError
        When the folder cannot be written.
    """
    arrays = {name: np.asarray(getattr(source, name)) for name in layout}
    write_npz(path, arrays, what=what, compressed=True)


def read_arrays(path: str | Path, layout: Layout, *, what: str, example: str) -> dict[str, Any]:
    """Return the arrays of a file in their types; what has no sides as a number of Python's.

    Parameters
    ----------
    path : str or Path
    layout : mapping of str to tuple
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
    arrays = read_npz(path, layout, what=what, advice=f"give a {example}", error=EyeglassesError)
    lengths: dict[str, int] = {}
    for name, (_, *shape) in layout.items():
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
    return {name: _typed(arrays[name], kind) for name, (kind, *_) in layout.items()}


def _typed(array: NDArray[Any], kind: type) -> Any:
    typed: NDArray[Any] = array.astype(kind, copy=False)
    return typed if typed.ndim else typed.item()


def _check_mesh(vertices: NDArray[Any], faces: NDArray[Any], place: str) -> None:
    if not np.isfinite(vertices).all():
        raise EyeglassesError(f"{place}: vertices are not finite; write it again")
    if faces.dtype.kind not in "iu" or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise EyeglassesError(f"{place}: faces are not those of its vertices; write it again")
