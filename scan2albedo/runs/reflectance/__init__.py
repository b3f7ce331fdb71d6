"""Runs and files of the `reflectance` commands: each writes one folder, the record last."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from pydantic import Field

from scan2albedo.core.arrays import Texts, Values
from scan2albedo.errors import ReflectanceError
from scan2albedo.io.records import Figures, OwnFileNames, Record
from scan2albedo.io.run_folder import OwnFiles, RunFolder, Staging

MODEL_FILE, MEAN_FILE, SHAPE_FILE = "reflectance_model.npz", "mean.npz", "shape_model.npz"


class ReflectanceRecord(Record):
    """The content of `reflectance.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    command: Literal["olat", "fit", "build", "sample", "fit-image", "finetune"]
    inputs: Texts = Field(description="Files, as given.")
    options: Figures = Field(description="What the command was called with.")
    metrics: Figures
    notes: Texts = ()
    files: OwnFileNames = ()


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


@contextmanager
def publishing(
    out: Path,
    command: str,
    inputs: Sequence[str | Path],
    options: Values,
    figures: Values,
    notes: Sequence[str] = (),
) -> Iterator[Staging[ReflectanceRecord]]:
    """Give the folder of a command's results, none of its `inputs`; its record is written last."""
    if any(Path(path).resolve() == out.resolve() for path in inputs):
        raise ReflectanceError(f"{out} is where the command reads from; write to another folder")
    with RunFolder(out, FILES).publishing() as results:
        yield results
        paths, said = tuple(map(str, inputs)), tuple(notes)
        results.write_record(command=command, inputs=paths, options=options, metrics=figures, notes=said)
