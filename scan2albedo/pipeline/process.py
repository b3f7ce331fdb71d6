"""`process`: a raw scan through every stage it needs, with a plan, a trace and files."""

from __future__ import annotations

import inspect
import os
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from scan2albedo.albedo import OPTIONAL_STEPS, AlbedoEstimate, EstimateOptions, estimate_albedo
from scan2albedo.core import Budget, Plan, ProgressCallback, RawScan, Trace
from scan2albedo.core.arguments import require_type
from scan2albedo.core.first_run import compiled_beside
from scan2albedo.core.raw_scan import is_folder_name, scan_name
from scan2albedo.errors import InsideOutError, memory_errors_named
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.fitting.plausibility import doubts, face_coverage
from scan2albedo.io import load_scan
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.io.leftovers import remove_leftovers
from scan2albedo.io.load_scan import with_landmarks
from scan2albedo.pipeline.detected_landmarks import require_detector, with_detected
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.plan_of_result import plan_of
from scan2albedo.pipeline.result import SURE, ProcessResult, own_files, write_result
from scan2albedo.pipeline.scale_search import ScaledScan, load_of_any_size, registered_at_any_scale
from scan2albedo.pipeline.unlit_stage import MOST_OF_BUDGET, unlit_seconds, without_light
from scan2albedo.registration import Registration, RegistrationOptions, register
from scan2albedo.registration.register import refined_registration
from scan2albedo.sampling import geometry_image, geometry_image_of_scan
from scan2albedo.templates import AnnotatedFaceModel, chosen_model

BUDGET_SHARES = {"register": 0.25, "fit": 0.4, "albedo": 0.9}
"""Share of the seconds still left for searching that each stage may take."""
WHOLE_FACE = 0.8
"""Part of the model with scan near, below which a person is warned: whole faces have 0.85 and more."""
KNOWN_LIGHT = 0.25
"""Relative standard deviation of a lamp's strength above which a person is warned."""
SAMPLING_S, DIVISION_S = 3e-6, 2e-6
"""Seconds a texel that a geometry image and the removal of its light take, whatever the budget."""

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


@dataclass(frozen=True, kw_only=True)
class _Call(ProcessOptions):
    """The parameters of `process`: its own, and the options."""

    source: str | Path | RawScan = field(kw_only=False)
    out: str | Path | None = field(default=None, kw_only=False)
    name: str | None = None
    on_progress: ProgressCallback | None = None


def _called_as(
    call: Callable[_Parameters, object],
) -> Callable[[Callable[..., _Result]], Callable[_Parameters, _Result]]:
    """Show type checkers, `help` and editors the parameters of `call` in place of `**options`."""

    def typed(function: Callable[..., _Result]) -> Callable[_Parameters, _Result]:
        returns = inspect.signature(function).return_annotation
        shown = inspect.signature(call).replace(return_annotation=returns)
        function.__signature__ = shown  # type: ignore[attr-defined]
        return function

    return typed


@_called_as(_Call)
def process(
    source: str | Path | RawScan,
    out: str | Path | None = None,
    *,
    name: str | None = None,
    on_progress: ProgressCallback | None = None,
    **options: Any,
) -> ProcessResult:
    """Return the result of one raw scan, taken through every stage it needs.

    Raises Scan2AlbedoError with one clear message when the scan cannot be read, holds no face, cannot be
    fitted, or the results cannot be written; earlier warnings of the stages are in its notes (`__notes__`).
    Raises ValueError for options that `ProcessOptions` refuses, TypeError for another source than a path or a
    `RawScan`.

    Parameters
    ----------
    source : path or RawScan
        The scan.
    out : path, optional
        Folder that gets a subfolder named after the scan with the files of the result.
    name : str, optional
        Name of the scan and of its folder; the file's stem, or that of the `RawScan`, when omitted.
    on_progress : callable, optional
        Called with every `TraceRow`.
    **options
        The fields of `ProcessOptions`, such as ``size=1024``, ``budget=20`` or ``skip=["albedo"]``.
    """
    advice = "give the path of a scan, or what load_scan(path) returns"
    require_type(source, (str, Path, RawScan), "process: source", advice)
    if out is not None:
        require_type(out, (str, Path), "process: out", "give the folder for the results")
    chosen = ProcessOptions(**options)
    # Result folders are checked before any work, so that an hour is not lost to a read-only disk.
    if out is not None:
        own_files(Path(out) / _name(source, name))
        check_writable(Path(out))
        remove_leftovers(Path(out))
    with memory_errors_named(_name(source, name)), compiled_beside():
        result = _processed(source, name, chosen, on_progress)
        if out is None:
            return result
        return replace(
            result, out=write_result(result, Path(out), files=chosen.files, pictures=chosen.pictures)
        )


def _name(source: str | Path | RawScan, name: str | None) -> str:
    """Return the name of the scan, and of its folder."""
    if name is not None:
        if not is_folder_name(name):
            raise ValueError(f"name is {name!r}, expected a name that a folder can have")
        return name
    return source.name if isinstance(source, RawScan) else scan_name(source)


@dataclass
class _Clock:
    """Times the stages of one run, and shares what is left of its budget among them."""

    options: ProcessOptions
    timings_s: dict[str, float] = field(default_factory=dict)
    start: float = field(default_factory=time.perf_counter)
    kept_s: float = 0.0
    """Seconds kept back for what follows the last search."""

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Time the block as a stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.timings_s[stage] = time.perf_counter() - begin

    def left_s(self) -> float:
        """Return the seconds left of the budget."""
        seconds = Budget.of(self.options.budget).seconds
        return float("inf") if seconds is None else seconds - (time.perf_counter() - self.start)

    def keep(self, seconds: float) -> None:
        """Keep seconds back, but no more than a part of the budget."""
        budget = Budget.of(self.options.budget).seconds
        self.kept_s = seconds if budget is None else min(seconds, MOST_OF_BUDGET * budget)

    def share(self, stage: str) -> Budget:
        """Return the stage's part of what is left of the budget."""
        budget = Budget.of(self.options.budget)
        if budget.seconds is None:
            return budget
        texel_s = DIVISION_S if stage == "albedo" else SAMPLING_S + DIVISION_S
        left = self.left_s() - texel_s * self.options.texels**2 - self.kept_s
        return replace(budget, seconds=max(left * BUDGET_SHARES[stage], 1e-3))


def _processed(
    source: str | Path | RawScan,
    name: str | None,
    options: ProcessOptions,
    on_progress: ProgressCallback | None,
) -> ProcessResult:
    """Take the scan through the stages; no file is written."""
    clock = _Clock(options)
    if options.landmarks_detected:
        require_detector()
    file = None if isinstance(source, RawScan) else Path(source)
    with clock.timed("load"):
        # Hashed before it is read: a file that changes meanwhile is stale at once.
        sha256 = input_sha256(file, options.textures) if file is not None and os.path.isfile(file) else None
        scan, scaled = _loaded(source, name, options)
        model = chosen_model(options.model)
    clock.keep(unlit_seconds(scan, options))
    registration, fitted, estimate = None, None, None
    unlit, template, unlit_plan = None, None, Plan(())
    with _warnings_as_messages() as messages:
        if model is None and not (options.landmarks is None and scan.landmarks is None):
            warnings.warn("landmarks are not used: without a model nothing is fitted to them", stacklevel=2)
        if model is not None and "register" not in options.skip:
            with clock.timed("register"):
                scan, registration = _registered(scan, scaled, model, clock, options, on_progress)
        if model is not None:
            pose = np.eye(4) if registration is None else registration.model_from_scan
            with clock.timed("fit"):
                if options.landmarks_detected:
                    scan = with_detected(scan, pose, clock.share("fit").seconds)
                fitted = fit(
                    scan, model, pose, clock.share("fit"), options=options.stages.fit, on_progress=on_progress
                )
                if registration is not None:
                    pose, scale = fitted.model_from_scan, fitted.metrics["scale"]
                    registration = refined_registration(registration, scan, model, pose, scale)
        with clock.timed("geometry_image"):
            if fitted is not None:
                image = geometry_image(fitted, scan, options.texels)
            else:
                image = geometry_image_of_scan(scan, options.texels)
        if image.texture_linear is not None and "albedo" not in options.skip:
            with clock.timed("albedo"):
                estimate = estimate_albedo(
                    image,
                    lights=options.lights,
                    brdf=options.brdf,
                    budget=clock.share("albedo"),
                    seed=options.seed,
                    options=_estimate_options(options),
                    on_progress=on_progress,
                )
        if options.unlit is not None or (fitted is not None and fitted.model.template_uv is not None):
            with clock.timed("unlit"):
                left = clock.left_s()
                unlit, template, unlit_plan = without_light(scan, fitted, estimate, options, left)
            for step in unlit_plan:
                if not step.ran:
                    warnings.warn(f"{step.stage} is left out: {step.reason}", stacklevel=2)
    ran = [stage for stage in (registration, fitted, estimate) if stage is not None]
    return ProcessResult(
        scan=scan,
        registration=registration,
        fitted=fitted,
        geometry_image=image,
        albedo=estimate,
        unlit=unlit,
        template=template,
        plan=plan_of(options, scan, registration, fitted, image, estimate) + unlit_plan,
        trace=sum((stage.trace for stage in ran), Trace()),
        timings_s=clock.timings_s,
        options=options.recorded(model),
        seed=options.seed,
        input_sha256=sha256,
        source=file,
        messages=(*messages, *_cautions(registration, fitted, estimate)),
    )


def _loaded(
    source: str | Path | RawScan, name: str | None, options: ProcessOptions
) -> tuple[RawScan, ScaledScan | None]:
    """Return the scan with the landmarks that are given; `scaled` where its unit is still to be found."""
    file, scaled = None if isinstance(source, RawScan) else Path(source), None
    if isinstance(source, RawScan):
        scan = source if name is None else replace(source, name=name)
    elif options.unit == "auto" and options.model != "none" and "register" not in options.skip:
        scaled = load_of_any_size(Path(source), name, options.textures)
        scan = scaled.scan
    else:
        scan = load_scan(source, unit=options.unit, name=name, textures=options.textures)
    if options.landmarks is not None and not options.landmarks_detected and options.model != "none":
        scan = with_landmarks(scan, options.landmarks, file)
        scaled = None if scaled is None else replace(scaled, scan=scan)
    return scan, scaled


def _registered(
    scan: RawScan,
    scaled: ScaledScan | None,
    model: AnnotatedFaceModel,
    clock: _Clock,
    options: ProcessOptions,
    on_progress: ProgressCallback | None,
) -> tuple[RawScan, Registration]:
    """Return the scan, its triangles reversed where they face inward, and the pose of its face.

    A scan whose unit nobody gave is `scaled`: it is brought to the scale at which it holds a face.
    """

    def registration(of: RawScan) -> Registration:
        share, stage = clock.share("register"), _registration_options(options)
        return register(of, model, share, options.seed, options=stage, on_progress=on_progress)

    def as_it_should_be(of: RawScan) -> tuple[RawScan, Registration]:
        try:
            return of, registration(of)
        except InsideOutError:
            note = (
                f"the scan was inside out: its {len(of.faces)} triangles were reversed. If the export was "
                "mirrored, left and right of the face are swapped: then mirror the scan and process it again"
            )
            turned = replace(of.inside_out(), notes=(*of.notes, note))
            return turned, registration(turned)

    return as_it_should_be(scan) if scaled is None else registered_at_any_scale(scaled, as_it_should_be)


def _registration_options(options: ProcessOptions) -> RegistrationOptions:
    """Return the preset's options with the step that the caller skips or forces."""
    preset, step = options.stages.registration, "register.depth_annealing"
    if step in options.skip:
        return replace(preset, annealing_evaluations=0)
    return replace(preset, force_annealing=True) if step in options.force else preset


def _estimate_options(options: ProcessOptions) -> EstimateOptions:
    """Return the preset's options with the steps that the caller skips or forces."""
    preset, asked = options.stages.albedo, {*options.skip, *options.force}

    def steps(of_preset: Sequence[str], of_caller: Sequence[str]) -> tuple[str, ...]:
        kept = (step for step in of_preset if step not in asked)
        return (*kept, *(step for step in of_caller if step in OPTIONAL_STEPS))

    return replace(preset, skip=steps(preset.skip, options.skip), force=steps(preset.force, options.force))


@contextmanager
def _warnings_as_messages() -> Iterator[list[str]]:
    """Give a list that holds the block's user warnings when it ends; other warnings pass on.

    An error that leaves the block carries them as notes, since there is no result then to hold them.
    """
    messages: list[str] = []
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            yield messages
    # Whatever ends the block carries the notes, and is raised again.
    except Exception as error:
        for warning in caught:
            if issubclass(warning.category, UserWarning):
                error.add_note(str(warning.message))
        raise
    finally:
        for warning in caught:
            if issubclass(warning.category, UserWarning):
                messages.append(str(warning.message))
            else:
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)


def _cautions(
    registration: Registration | None, fitted: FittedFace | None, estimate: AlbedoEstimate | None
) -> Iterator[str]:
    """Yield what a person should doubt: the pose, the face that was fitted, a light that is hardly known."""
    if registration is not None and registration.confidence < SURE:
        yield (
            f"the pose is unsure (confidence {registration.confidence:.2f}): another one is nearly as good, "
            "or the scan hardly resembles a face; look at overview.png"
        )
    coverage = 1.0 if fitted is None else face_coverage(fitted)
    if coverage < WHOLE_FACE:
        covered = fitted is not None and fitted.metrics["covered_mm2"] > 0
        why = (
            "what lies before the eyes was left out" if covered else "is the file cut short, or half a face?"
        )
        yield f"only {100 * coverage:.0f} % of the face has scan near it, else the model's own shape: {why}"
    if fitted is not None:
        yield from doubts(fitted)
    if estimate is None:
        return
    unsure = 0.0 if estimate.uncertainty is None else max(estimate.uncertainty.intensity, default=0.0)
    if unsure > KNOWN_LIGHT:
        yield f"a lamp's strength is known to {100 * unsure:.0f} % only: its light may be in the albedo"
    yield from (
        f"{step.reason}: {step.evidence}"
        for step in estimate.plan
        if step.stage == "albedo.limits" and step.ran
    )
