"""One run over several takes of a person: each scan is fitted, or left out by name.

A take is one scan of a person, in a pose and with an expression of its own. `process_person` joins takes by
the prior of one shape and one albedo, `process_sequence` by that of a motion in time.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from scan2albedo.core import OnProgress, PlanStep, RawScan
from scan2albedo.core.raw_scan import is_folder_name
from scan2albedo.errors import Scan2AlbedoError, one_line
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.run_folder import RunFolder
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.process import FILES, process, write_result
from scan2albedo.pipeline.result import ProcessResult
from scan2albedo.templates import chosen_model

Source = str | Path | RawScan
Fit = TypeVar("Fit")


@dataclass(frozen=True)
class Take(Generic[Fit]):
    """A scan of a person: its `name`, its `fit` or the `error` that left it out, and the CPU it took."""

    name: str
    fit: Fit | None
    error: Scan2AlbedoError | None
    cpu_s: float

    @property
    def reason(self) -> str:
        """Why it was left out, in one line."""
        return "" if self.error is None else one_line(self.error)


class Takes:
    """The takes of a person called `name`, with the `options` of `process`; files go to `out`.

    Raises ValueError for a name that no folder can have and for what takes cannot be processed with,
    OutputError when the folder cannot be written. Takes with a time need a `model` with landmarks.
    """

    def __init__(
        self,
        name: str,
        out: str | Path | None,
        options: ProcessOptions,
        on_progress: OnProgress,
        *,
        timed: bool = False,
    ) -> None:
        if not is_folder_name(name):
            raise ValueError(f"name is {name!r}, expected a folder's name")
        if options.linear_model is not None:
            raise ValueError("linear_model is fitted to single scans: process them with it one by one")
        model = chosen_model(options.model)
        if model is None or (timed and model.landmark_points is None):
            raise ValueError("a person needs the model of a face with landmarks, as the default one is")
        self.name = name
        self.out = None if out is None else Path(out)
        self.options = options
        self.model = model
        self.on_progress = on_progress
        self.doubts = list[PlanStep]()
        if self.out is not None:
            RunFolder(self.out / name, FILES).check()
            check_writable(self.out)

    def processed(self, source: Source, name: str, **changes: Any) -> ProcessResult:
        """Return what `process` makes of one scan alone, with options that differ by `changes`."""
        options = replace(self.options, **{"model": self.model} | changes)
        return process(source, None, options, name=name, on_progress=self.on_progress)

    def each(
        self, scans: Iterable[tuple[str, Source]], fit: Callable[[str, Source], Fit]
    ) -> Iterator[Take[Fit]]:
        """Yield every scan fitted, or left out when it cannot be used."""
        for name, source in scans:
            begin = time.process_time()
            found = None
            failed = None
            try:
                found = fit(name, source)
            except Scan2AlbedoError as error:
                failed = error
            yield Take(name, found, failed, time.process_time() - begin)

    def doubt(self, stage: str, take: str, *notes: str) -> None:
        """Add a row to the plan for each note about a take."""
        self.doubts += [PlanStep.doubt(stage, f"{take}: {note}") for note in notes]

    def write(self, result: ProcessResult, out: Path) -> Path:
        """Write the files of a result into a folder of its name in `out`; return that folder."""
        return write_result(result, out, files=self.options.files, pictures=self.options.pictures)
