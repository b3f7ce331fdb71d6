"""`process`: a raw scan through the stages, with a plan, a trace and files."""

from collections.abc import Collection
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Unpack

from scan2albedo.core import Budget, OnProgress, Plan, RawScan
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import Texts
from scan2albedo.core.raw_scan import is_folder_name, scan_name
from scan2albedo.errors import memory_errors_of
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.leftovers import remove_leftovers
from scan2albedo.io.result_records import RESULT_FILE, InputRecord, ResultRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.pipeline.clock import Clock
from scan2albedo.pipeline.options import ProcessChanges, ProcessOptions
from scan2albedo.pipeline.overview import result_panels
from scan2albedo.pipeline.result import ProcessResult, Run
from scan2albedo.pipeline.stages import Files, FindAlbedo, Fit, FitLinearModel, Load, Register, Sample, Stage
from scan2albedo.pipeline.unlit import Unlit
from scan2albedo.report.overview import overview_picture

STAGES: list[Stage] = [Load(), Register(), Fit(), Sample(), FitLinearModel(), FindAlbedo(), Unlit()]
"""The way of a scan; one that is appended writes files of its own."""
PICTURES = ("overview.png", "error_vs_time.png")


def own_files() -> OwnFiles[ResultRecord]:
    """Return every file a result may have: those of `STAGES`, then those of a person and of a sequence."""
    names = (
        *(name for stage in STAGES for name in (*stage.files, *stage.details)),
        *("trace.csv", *PICTURES),
        *("coverage.png", "disagreement.png", "sequence.glb", "frames.npz"),
    )
    return OwnFiles(RESULT_FILE, ResultRecord, names, whole_folder=True)


FILES = own_files()
"""Those of the stages that there are from the beginning."""


def process(
    source: str | Path | RawScan,
    out: str | Path | None = None,
    options: ProcessOptions | None = None,
    *,
    name: str | None = None,
    on_progress: OnProgress = None,
    **changes: Unpack[ProcessChanges],
) -> ProcessResult:
    """Return the result of one raw scan, taken through every stage it needs.

    Raises Scan2AlbedoError with one clear message when the scan cannot be read, holds no face, cannot be
    fitted, or the results cannot be written; earlier doubts of the stages are in its notes (`__notes__`).
    Raises ValueError for options that `ProcessOptions` refuses, TypeError for unknown options and for another
    source than a path or a `RawScan`.

    Parameters
    ----------
    source : path or RawScan
    out : path, optional
        Folder that gets a subfolder named after the scan with the files of the result.
    options : ProcessOptions, optional
        How the stages go about it.
    name : str, optional
        Name of the scan and of its folder; the file's stem, or that of the `RawScan`, when omitted.
    on_progress : callable, optional
        Called with every `TraceRow`.
    **changes
        Options by their names in `ProcessOptions`, in place of those in `options`.
    """
    chosen = ProcessOptions.with_changes(options, changes)
    advice = "give the path of a scan, or what load_scan(path) returns"
    require_type(source, (str, Path, RawScan), "process: source", advice)
    if out is not None:
        require_type(out, (str, Path), "process: out", "give the folder for the results")
    if name is None:
        known = source.name if isinstance(source, RawScan) else scan_name(source)
    elif not is_folder_name(known := name):
        raise ValueError(f"name is {name!r}, expected a name that a folder can have")
    # Result folders are checked before any work, so that an hour is not lost to a read-only disk.
    if out is not None:
        RunFolder(Path(out) / known, own_files()).check()
        check_writable(Path(out))
        remove_leftovers(Path(out))
    run, clock = Run(source, chosen, name, on_progress), Clock(Budget.of(chosen.budget))
    with memory_errors_of(known):
        try:
            load, *others = STAGES
            run.plan[load.name] = load.run(run, clock)
            clock.due_s = {stage.name: stage.cost_s(run) for stage in others}
            for stage in others:
                run.plan[stage.name] = stage.run(run, clock)
        except Exception as error:  # whatever ends the run, it carries what the stages doubted before
            for step in Plan(tuple(chain(*run.plan.values()))).doubts():
                error.add_note(step.text)
            raise
        result = run.result(clock.timings_s)
        if out is None:
            return result
        folder = write_result(result, Path(out), files=chosen.files, pictures=chosen.pictures)
        return replace(result, out=folder)


def write_result(
    result: ProcessResult,
    out: Path,
    *,
    files: str = "standard",
    pictures: bool = True,
    recorded: Collection[str] = (),
) -> Path:
    """Write every file of a result into ``out / <scan name>`` and return that folder.

    They appear all at once, and an older result stays until then, see `RunFolder`; `recorded` are files that
    a batch's record says an earlier run wrote. `overview.png` and `error_vs_time.png` are left out without
    `pictures`, they and `Stage.details` where `files` is "minimal"; "all" adds linear EXR of the unlit scan
    and of the template. Raises `OutputError` when the folder is somebody else's or cannot be written.
    """
    left_out: Texts = () if pictures else PICTURES
    if files == "minimal":
        left_out = (*PICTURES, *(name for stage in STAGES for name in stage.details))
    folder = RunFolder(out / result.scan.name, own_files(), recorded)
    with folder.publishing() as staging:
        written = Files(staging.folder, left_out, exr=files == "all")
        for stage in STAGES:
            stage.write(result, written)
        result.write_more(staging.folder)
        written.write("trace.csv", result.trace.to_csv)
        if "overview.png" not in left_out:
            overview = overview_picture(result.summary(), result_panels(result), 6)
            written.write("overview.png", overview.save, compress_level=1)
            written.write("error_vs_time.png", result.trace.plot().savefig)
        albedo = result.albedo
        own = None if result.fitted is None else result.fitted.model.template_from_model
        staging.write_record(
            name=result.scan.name,
            seed=result.seed,
            options=dict(result.options),
            input=InputRecord.of(result.scan, result.source, result.input_sha256),
            plan=tuple(result.plan),
            metrics=result.metrics(),
            lights=() if albedo is None else tuple(albedo.lights),
            environment=None if albedo is None else albedo.environment,
            parameters={} if albedo is None else albedo.parameters,
            timings_s=dict(result.timings_s),
            notes=result.notes,
            template_from_model=None if own is None else own.tolist(),
        )
    return folder.path
