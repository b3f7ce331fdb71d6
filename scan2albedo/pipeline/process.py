"""`process`: a raw scan through every stage it needs, with a plan, a trace and files."""

from __future__ import annotations

import inspect
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.albedo import AlbedoEstimate, EstimateOptions, estimate_albedo
from scan2albedo.core import Budget, GeometryImage, Plan, PlanStep, ProgressCallback, RawScan, Trace
from scan2albedo.face_model import AnnotatedFaceModel, chosen_model
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.geometry_image import geometry_image, geometry_image_of_scan
from scan2albedo.io import load_scan
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.pipeline.options import ProcessOptions, process_options
from scan2albedo.pipeline.result import ProcessResult, write_result
from scan2albedo.registration import Registration, RegistrationOptions, register

BUDGET_SHARES = {"register": 0.25, "fit": 0.4, "albedo": 0.9}
"""Share of the seconds still left for searching that each stage may take."""
WHOLE_FACE = 0.8
"""Part of the model with scan near, below which a person is warned: whole faces have 0.85 and more."""
SAMPLING_S, DIVISION_S = 3e-6, 2e-6
"""Seconds a texel that a geometry image and the removal of its light take, whatever the budget."""


def process(
    source: str | Path | RawScan,
    out: str | Path | None = None,
    *,
    name: str | None = None,
    on_progress: ProgressCallback | None = None,
    **options: Any,
) -> ProcessResult:
    """Take one raw scan through every stage it needs.

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

    Returns
    -------
    ProcessResult

    Raises
    ------
    Scan2AlbedoError
        With one clear message: the scan cannot be read, holds no face, cannot be fitted, or the
        results cannot be written. What the stages warned of before is in its notes (`__notes__`).
    ValueError
        For options that `ProcessOptions` refuses.
    """
    run = _Run(ProcessOptions(**options), on_progress)
    # Result folders are checked before any work, so that an hour is not lost to a read-only disk.
    if out is not None:
        check_writable(Path(out))
    result = run.result(source, name)
    if out is None:
        return result
    return replace(result, out=write_result(result, Path(out), pictures=run.options.pictures))


def _show_options() -> None:
    """Let `help` and editors show the options among the parameters of `process`."""
    shown = inspect.signature(process)
    own = [parameter for parameter in shown.parameters.values() if parameter.name != "options"]
    chosen = [
        inspect.Parameter(
            option.name, inspect.Parameter.KEYWORD_ONLY, default=option.default, annotation=option.type
        )
        for option in process_options()
    ]
    process.__signature__ = shown.replace(parameters=[*own, *chosen])  # type: ignore[attr-defined]


_show_options()


@dataclass
class _Run:
    """One scan on its way through the stages: clock, plan and trace."""

    options: ProcessOptions
    on_progress: ProgressCallback | None
    plan: Plan = field(default_factory=Plan)
    trace: Trace = field(default_factory=Trace)
    timings_s: dict[str, float] = field(default_factory=dict)
    start: float = field(default_factory=time.perf_counter)

    def result(self, source: str | Path | RawScan, name: str | None) -> ProcessResult:
        """Take the scan through the stages; no file is written."""
        with self.timed("load"):
            file = None if isinstance(source, RawScan) else Path(source)
            # Hashed before it is read: a file that changes meanwhile is stale at once.
            sha256 = input_sha256(file) if file is not None and file.is_file() else None
            if not isinstance(source, RawScan):
                scan = load_scan(source, unit=self.options.unit, name=name)
            else:
                scan = source if name is None else replace(source, name=name)
            model = chosen_model(self.options.model)
        with _warnings_as_messages() as messages:
            registration, fitted = None, None
            if model is None:
                image = self.charts(scan)
            else:
                registration = self.registration(scan, model)
                fitted = self.fit(scan, model, registration)
                image = self.geometry_image(fitted, scan)
            estimate = self.albedo(image, scan)
        if fitted is not None:
            messages += _cautions(fitted)
        return ProcessResult(
            scan=scan,
            registration=registration,
            fitted=fitted,
            geometry_image=image,
            albedo=estimate,
            plan=self.plan,
            trace=self.trace,
            timings_s=self.timings_s,
            options=self.options.recorded(model),
            seed=self.options.seed,
            input_sha256=sha256,
            source=file,
            messages=tuple(messages),
        )

    def registration(self, scan: RawScan, model: AnnotatedFaceModel) -> Registration | None:
        """Register, unless the caller says that the scan lies in place."""
        if "register" in self.options.skip:
            self.note(
                "register", False, "skipped by the caller: the scan is taken to lie in the model's frame"
            )
            return None
        with self.timed("register"):
            registration = register(
                scan,
                model,
                self.share("register"),
                self.options.seed,
                options=_registration_options(self.options),
                on_progress=self.on_progress,
            )
        self.trace += registration.trace
        self.note("register", True, "pose of the face in the scan", f"rmse {registration.rmse_mm:.2f} mm")
        for step, ran, reason, evidence in registration.notes:
            self.note(f"register.{step}", ran, reason, evidence)
        return registration

    def fit(self, scan: RawScan, model: AnnotatedFaceModel, registration: Registration | None) -> FittedFace:
        """Deform the model onto the scan."""
        pose = np.eye(4) if registration is None else registration.model_from_scan
        with self.timed("fit"):
            fitted = fit(
                scan,
                model,
                pose,
                self.share("fit"),
                options=self.options.stages.fit,
                on_progress=self.on_progress,
            )
        self.trace += fitted.trace
        evidence = f"{np.nanmean(fitted.residual_mm):.3f} mm mean"
        self.note("fit", True, "the model is deformed onto the scan", evidence)
        return fitted

    def geometry_image(self, fitted: FittedFace, scan: RawScan) -> GeometryImage:
        """Sample the fitted face and the scan's colour over the model's chart."""
        with self.timed("geometry_image"):
            image = geometry_image(fitted, scan, self.options.texels)
        evidence = _evenness(image)
        if scan.has_color:
            evidence += f", texture seen in {image.figures()['seen']:.1%} of them"
        self.note("geometry_image", True, "the model's own chart", evidence)
        return image

    def charts(self, scan: RawScan) -> GeometryImage:
        """Sample the scan itself, without a model."""
        for stage in ("register", "fit"):
            self.note(stage, False, "no model was asked for")
        with self.timed("geometry_image"):
            image = geometry_image_of_scan(scan, self.options.texels)
        self.note("geometry_image", True, "charts cut by xatlas", _evenness(image))
        return image

    def albedo(self, image: GeometryImage, scan: RawScan) -> AlbedoEstimate | None:
        """Estimate the albedo, unless skipped or there is no colour."""
        if "albedo" in self.options.skip:
            self.note("albedo", False, "skipped by the caller")
            return None
        if image.texture_linear is None:
            self.note("albedo", False, "the scan has no usable colour", "; ".join(scan.notes))
            return None
        with self.timed("albedo"):
            estimate = estimate_albedo(
                image,
                lights=self.options.lights,
                brdf=self.options.brdf,
                budget=self.share("albedo"),
                seed=self.options.seed,
                options=_estimate_options(self.options),
                on_progress=self.on_progress,
            )
        self.trace += estimate.trace
        self.plan += estimate.plan
        return estimate

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Time the block as a stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.timings_s[stage] = time.perf_counter() - begin

    def share(self, stage: str) -> Budget:
        """Return the stage's part of what is left of the budget."""
        budget = Budget.of(self.options.budget)
        if budget.seconds is None:
            return budget
        texel_s = DIVISION_S if stage == "albedo" else SAMPLING_S + DIVISION_S
        left = budget.seconds - (time.perf_counter() - self.start) - texel_s * self.options.texels**2
        return replace(budget, seconds=max(left * BUDGET_SHARES[stage], 1e-3))

    def note(self, stage: str, ran: bool, reason: str, evidence: str = "") -> None:
        """Add a row to the plan."""
        self.plan += Plan((PlanStep(stage, ran, reason, evidence),))


def _registration_options(options: ProcessOptions) -> RegistrationOptions:
    """Return the preset's options with the step that the caller skips or forces."""
    preset, asked = options.stages.registration, options.asked("register.depth_annealing")
    if asked is None:
        return preset
    return replace(preset, force_annealing=True) if asked else replace(preset, annealing_evaluations=0)


def _estimate_options(options: ProcessOptions) -> EstimateOptions:
    """Return the preset's options with the steps that the caller skips or forces."""
    preset = options.stages.albedo
    return replace(
        preset,
        shadows=options.asked("albedo.shadows", preset.shadows),
        near_light=options.asked("albedo.near_light", preset.near_light),
        roughness=options.asked("albedo.roughness", preset.roughness),
        specular=options.asked("albedo.specular", preset.specular),
        rectification=options.asked("albedo.rectification", preset.rectification),
        inpainting=options.asked("albedo.inpainting", preset.inpainting),
    )


@contextmanager
def _warnings_as_messages() -> Iterator[list[str]]:
    """Give a list that holds the user warnings of the block when it ends; other warnings pass on.

    An error that leaves the block carries them as notes, for there is no result then to hold them.
    """
    messages: list[str] = []
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            yield messages
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


def _cautions(fitted: FittedFace) -> list[str]:
    """Return what a person should know of a fit that looks good where there was a scan."""
    coverage = fitted.metrics["coverage"]
    if coverage >= WHOLE_FACE:
        return []
    return [
        f"only {100 * coverage:.0f} % of the face has scan near it, the rest is the model's own shape: is "
        "the file cut short, or is it half a face?"
    ]


def _evenness(image: GeometryImage) -> str:
    figures = image.figures()
    return (
        f"{figures['coverage']:.1%} of the texels used, {figures['texel_area_mm2']:.2f} mm2 each, "
        f"areas within a factor of {figures['texel_area_p95_to_p5']:.1f} (5 to 95 %)"
    )
