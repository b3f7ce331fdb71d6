"""Folders that the `reflectance` commands write: made aside, renamed into place, the record last."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo import __version__
from scan2albedo.io.atomic import make_folder
from scan2albedo.io.images import write_png
from scan2albedo.io.reflectance_json import REFLECTANCE_FILE, ReflectanceRecord
from scan2albedo.io.result_json import write_record
from scan2albedo.staging import publish, staging_folder, telling_where

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 110


class Results:
    """The files of one command as they are made, in a hidden folder."""

    def __init__(self, folder: Path, command: str, inputs: Sequence[str | Path]) -> None:
        self.folder, self._command, self._inputs = folder, command, inputs

    def picture(self, name: str, pixels: NDArray[np.uint8]) -> None:
        """Write a picture (H, W, 3)."""
        write_png(self.folder / name, pixels)

    def figure(self, name: str, figure: Figure) -> None:
        """Write a matplotlib figure."""
        figure.savefig(self.folder / name, dpi=_DPI)

    def finish(
        self, metrics: Mapping[str, Any], *, options: Mapping[str, Any], notes: Sequence[str] = ()
    ) -> None:
        """Write the record; call it last."""
        files = sorted(path.name for path in self.folder.iterdir())
        record = ReflectanceRecord.model_validate(
            {
                "scan2albedo_version": __version__,
                "command": self._command,
                "inputs": tuple(str(path) for path in self._inputs),
                "options": dict(options),
                "metrics": dict(metrics),
                "notes": tuple(notes),
                "files": (*files, REFLECTANCE_FILE),
            }
        )
        write_record(self.folder / REFLECTANCE_FILE, record)


@contextmanager
def folder_of_results(out: Path, command: str, inputs: Sequence[str | Path]) -> Iterator[Results]:
    """Give a hidden folder whose files go to `out` when the block ends without an error.

    Raises
    ------
    OutputError
        Naming the folder and the cause.
    """
    with telling_where(out), staging_folder(make_folder(out), "reflectance") as staging:
        yield Results(staging, command, inputs)
        publish(staging, out, REFLECTANCE_FILE)
