"""Folders that the `reflectance` commands write: made aside, renamed into place, the record last."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scan2albedo.core.version import VERSION
from scan2albedo.errors import ReflectanceError
from scan2albedo.io.atomic import result_folder
from scan2albedo.io.images import write_png
from scan2albedo.io.records import Figures, Record, listed_files, write_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REFLECTANCE_FILE = "reflectance.json"
_DPI = 110


class ReflectanceRecord(Record):
    """The content of `reflectance.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    command: Literal["olat", "fit", "build", "sample", "fit-image", "finetune"]
    inputs: tuple[str, ...] = Field(description="Files, as given.")
    options: Figures = Field(description="What the command was called with.")
    metrics: Figures
    notes: tuple[str, ...] = ()
    files: tuple[str, ...] = Field((), description="Names of the files beside this one.")


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

    def write_record(
        self, metrics: Mapping[str, Any], *, options: Mapping[str, Any], notes: Sequence[str] = ()
    ) -> None:
        """Write the record; call it last."""
        files = sorted(path.name for path in self.folder.iterdir())
        record = ReflectanceRecord.model_validate(
            {
                "scan2albedo_version": VERSION,
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

    Files that only an earlier result had are removed. Raises `ReflectanceError` when `out` is one of the
    `inputs`, whose record it would replace, `OutputError` when it cannot be written.
    """
    if any(Path(path).resolve() == out.resolve() for path in inputs):
        raise ReflectanceError(f"{out} is where {command} reads from; write to another folder")
    older = listed_files(out / REFLECTANCE_FILE, ReflectanceRecord)
    with result_folder(out, REFLECTANCE_FILE, obsolete=older) as staging:
        yield Results(staging, command, inputs)
