"""`process`: a raw scan through every stage it needs, with a plan, a trace and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scan2albedo.core import Budget, ProgressCallback, RawScan, checked_seed
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.pipeline.choices import check_choices, check_stage_names
from scan2albedo.pipeline.quality import Quality, quality_of
from scan2albedo.pipeline.result import ProcessResult
from scan2albedo.pipeline.run import PipelineRun


def process(
    source: str | Path | RawScan,
    out: str | Path | None = None,
    *,
    model: AnnotatedFaceModel | str | Path | None = None,
    size: int | None = None,
    lights: int | str = "auto",
    brdf: str = "oren-nayar",
    unit: str = "auto",
    quality: Quality | str = "standard",
    budget: Budget | float | None = None,
    seed: int = 0,
    skip: Sequence[str] = (),
    force: Sequence[str] = (),
    pictures: bool = True,
    name: str | None = None,
    on_progress: ProgressCallback | None = None,
) -> ProcessResult:
    """Take one raw scan through every stage it needs.

    Parameters
    ----------
    source : path or RawScan
        The scan.
    out : path, optional
        Folder that gets a subfolder named after the scan with the files of the result.
    model : AnnotatedFaceModel, path, "default" or "none", optional
        The template, from a model's JSON file or a mesh (`AnnotatedFaceModel.from_mesh`); the default
        model when omitted. "none" processes any object without a face: xatlas charts, no registration,
        no fit.
    size : int, optional
        Height and width of the geometry image; that of `quality` when omitted, 512 for "standard".
    lights : "auto" or int
        How many lights; "auto" decides by evidence.
    brdf : str
        "oren-nayar", "lambert", "minnaert" or "spherical-harmonics".
    unit : str
        "auto", "mm", "cm" or "m".
    quality : str or Quality
        "draft", "standard" or "best", or the options of every stage.
    budget : Budget or float, optional
        Seconds for the whole run, or a Budget whose evaluations hold for each stage.
    seed : int
        Same seed, input and budget in evaluations: same result, bit by bit.
    skip : sequence of str
        Names from `choices.STAGES` to leave out.
    force : sequence of str
        Names from `choices.FORCEABLE`: steps to carry out whatever the evidence says, where there is
        anything to do (a shadow's outline to rectify, a saturated texel to inpaint).
    pictures : bool
        Whether overview.png and error_vs_time.png are drawn among the files.
    name : str, optional
        Name of the scan and of its folder; the file's stem, or that of the `RawScan`, when omitted.
    on_progress : callable, optional
        Called with every `TraceRow`.

    Returns
    -------
    ProcessResult

    Raises
    ------
    Scan2AlbedoError
        With one clear message: the scan cannot be read, holds no face, cannot be fitted, or the
        results cannot be written.
    ValueError
        For an unknown stage, BRDF, unit or quality, a stage that cannot be skipped or forced, or is both, a
        size or number of lights out of range, a seed or budget that is none.
    """
    check_stage_names(skip, force)
    chosen = quality_of(quality)
    size = chosen.size if size is None else size
    check_choices(size, lights, brdf, unit)
    run = PipelineRun(
        Budget.of(budget), chosen, frozenset(skip), frozenset(force), checked_seed(seed), size, on_progress
    )
    # Result folders are checked before any work, so that an hour is not lost to a read-only disk.
    if out is not None:
        from scan2albedo.io.result_folder import check_writable

        check_writable(Path(out))
    result = run.result(source, model, name, lights=lights, brdf=brdf, unit=unit)
    if out is None:
        return result
    from scan2albedo.pipeline.result_files import write_result

    return replace(result, out=write_result(result, Path(out), pictures=pictures))
