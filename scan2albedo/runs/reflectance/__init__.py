"""Runs and files of the `reflectance` commands: each writes one folder, the record last."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from pydantic import Field

from scan2albedo.errors import ReflectanceError
from scan2albedo.io.records import Figures, Record
from scan2albedo.io.run_folder import OwnFiles, RunFolder

MODEL_FILE, MEAN_FILE, SHAPE_FILE = "reflectance_model.npz", "mean.npz", "shape_model.npz"


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


FILES = OwnFiles(
    "reflectance.json",
    ReflectanceRecord,
    (
        *("olat_*.exr", "olat.png", "reflectance.npz", "face.ply", "trace.csv", "error_vs_time.png"),
        *("overview.png", "relit.png", MODEL_FILE, MEAN_FILE, SHAPE_FILE, "model.png"),
        *("sample_*.npz", "samples.png"),
    ),
    command="scan2albedo reflectance",
)


def results_in(out: Path, inputs: Sequence[str | Path]) -> RunFolder[ReflectanceRecord]:
    """Return the folder of a command's results.

    Raises `ReflectanceError` when `out` is one of the `inputs`, whose record it would replace.
    """
    if any(Path(path).resolve() == out.resolve() for path in inputs):
        raise ReflectanceError(f"{out} is where the command reads from; write to another folder")
    return RunFolder(out, FILES)


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Name a file, in words, in errors that do not."""
    try:
        yield
    except ReflectanceError as error:
        if what in str(error):
            raise
        raise ReflectanceError(f"{what}: {error}") from error
