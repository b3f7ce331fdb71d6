"""`process`: a raw scan through every stage it needs, with a plan, a trace and files."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from scan2albedo.albedo import AlbedoEstimate, EstimateOptions, estimate_albedo
from scan2albedo.choices import check_choices, check_stage_names
from scan2albedo.errors import ModelError
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.face_model.template_file import TEMPLATE_FILES, model_from_file
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.io import GeometryImage, RawScan, load_scan
from scan2albedo.optimization import Budget, Plan, PlanStep, ProgressCallback, Trace, checked_seed
from scan2albedo.process_result import ProcessResult
from scan2albedo.quality import Quality, quality_of
from scan2albedo.registration import Registration, RegistrationOptions, register
from scan2albedo.sampling import geometry_image, geometry_image_of_scan

BUDGET_SHARES = {"register": 0.25, "fit": 0.4, "albedo": 0.9}
"""Share of the seconds still left for searching that each stage may take."""
SAMPLING_S, DIVISION_S = 3e-6, 2e-6
"""Seconds a texel that a geometry image and the removal of its light take, whatever the budget."""


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
    run = _Run(
        Budget.of(budget), chosen, frozenset(skip), frozenset(force), checked_seed(seed), size, on_progress
    )
    # Result folders are checked before any work, so that an hour is not lost to a read-only disk.
    if out is not None:
        from scan2albedo.result_files import check_writable

        check_writable(Path(out))
    result = run.result(source, model, name, lights=lights, brdf=brdf, unit=unit)
    if out is None:
        return result
    from scan2albedo.result_files import write_result

    return replace(result, out=write_result(result, Path(out), pictures=pictures))


@contextmanager
def _kept_messages() -> Iterator[list[str]]:
    """Give a list that holds the user warnings of the block when it ends; other warnings pass on."""
    messages: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield messages
    for warning in caught:
        if issubclass(warning.category, UserWarning):
            messages.append(str(warning.message))
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)


def _scan(source: str | Path | RawScan, unit: str, name: str | None) -> RawScan:
    if not isinstance(source, RawScan):
        return load_scan(source, unit=unit, name=name)
    return source if name is None else replace(source, name=name)


def _evenness(image: GeometryImage) -> str:
    figures = image.figures()
    return (
        f"{figures['coverage']:.1%} of the texels used, {figures['texel_area_mm2']:.2f} mm2 each, "
        f"areas within a factor of {figures['texel_area_p95_to_p5']:.1f} (5 to 95 %)"
    )


def chosen_model(model: AnnotatedFaceModel | str | Path | None) -> AnnotatedFaceModel | None:
    """Return the model that a user means: a model, a file of one or of a template, "default" or "none".

    Raises
    ------
    ModelError
        When there is no such file, or it holds neither.
    """
    if isinstance(model, AnnotatedFaceModel):
        return model
    if model is None or str(model) == "default":
        return AnnotatedFaceModel.default()
    if str(model) == "none":
        return None
    if not Path(model).is_file():
        raise ModelError(
            f"{model}: no such file; give a model's JSON file, a template's mesh, 'default' or 'none'"
        )
    if Path(model).suffix.lower() in TEMPLATE_FILES:
        return model_from_file(model)
    return AnnotatedFaceModel.load(model)


@dataclass
class _Run:
    """The state of one run: clock, plan and trace."""

    budget: Budget
    quality: Quality
    skip: frozenset[str]
    force: frozenset[str]
    seed: int
    size: int
    on_progress: ProgressCallback | None
    plan: Plan = field(default_factory=Plan)
    trace: Trace = field(default_factory=Trace)
    timings_s: dict[str, float] = field(default_factory=dict)
    start: float = field(default_factory=time.perf_counter)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.timings_s[stage] = time.perf_counter() - begin

    def result(
        self,
        source: str | Path | RawScan,
        model: AnnotatedFaceModel | str | Path | None,
        name: str | None,
        *,
        lights: int | str,
        brdf: str,
        unit: str,
    ) -> ProcessResult:
        """Take the scan through the stages; no file is written."""
        with self.timed("load"):
            scan = _scan(source, unit, name)
            template = chosen_model(model)
        with _kept_messages() as messages:
            registration, fitted, image = self.geometry(scan, template)
            estimate = self.albedo(image, scan, lights, brdf)
        options = {
            "size": self.size,
            "lights": lights,
            "brdf": brdf,
            "unit": unit,
            "quality": self.quality.name,
            "skip": sorted(self.skip),
            "force": sorted(self.force),
            "budget_seconds": self.budget.seconds,
            "budget_evaluations": self.budget.evaluations,
            "model": "none" if template is None else template.name,
        }
        return ProcessResult(
            scan,
            registration,
            fitted,
            image,
            estimate,
            self.plan,
            self.trace,
            self.timings_s,
            options,
            self.seed,
            source=None if isinstance(source, RawScan) else Path(source),
            messages=tuple(messages),
        )

    def share(self, stage: str) -> Budget:
        """Return the stage's part of what is left of the budget."""
        if self.budget.seconds is None:
            return self.budget
        texel_s = DIVISION_S if stage == "albedo" else SAMPLING_S + DIVISION_S
        left = self.budget.seconds - (time.perf_counter() - self.start) - texel_s * self.size**2
        return replace(self.budget, seconds=max(left * BUDGET_SHARES[stage], 1e-3))

    def note(self, stage: str, ran: bool, reason: str, evidence: str = "") -> None:
        self.plan += Plan((PlanStep(stage, ran, reason, evidence),))

    def geometry(
        self, scan: RawScan, model: AnnotatedFaceModel | None
    ) -> tuple[Registration | None, FittedFace | None, GeometryImage]:
        if model is None:
            for stage in ("register", "fit"):
                self.note(stage, False, "no model was asked for")
            with self.timed("geometry_image"):
                image = geometry_image_of_scan(scan, self.size)
            self.note("geometry_image", True, "charts cut by xatlas", _evenness(image))
            return None, None, image
        registration = self.registration(scan, model)
        pose = np.eye(4) if registration is None else registration.model_from_scan
        with self.timed("fit"):
            fitted = fit(
                scan,
                model,
                pose,
                self.share("fit"),
                options=self.quality.fit,
                on_progress=self.on_progress,
            )
        self.trace += fitted.trace
        self.note(
            "fit",
            True,
            "the model is deformed onto the scan",
            f"{np.nanmean(fitted.residual_mm):.3f} mm mean",
        )
        with self.timed("geometry_image"):
            image = geometry_image(fitted, scan, self.size)
        evidence = _evenness(image)
        if scan.has_color:
            evidence += f", texture seen in {image.figures()['seen']:.1%} of them"
        self.note("geometry_image", True, "the model's own chart", evidence)
        return registration, fitted, image

    def registration(self, scan: RawScan, model: AnnotatedFaceModel) -> Registration | None:
        if "register" in self.skip:
            self.note(
                "register", False, "skipped by the caller: the scan is taken to lie in the model's frame"
            )
            return None
        with self.timed("register"):
            registration = register(
                scan,
                model,
                self.share("register"),
                self.seed,
                options=self.registration_options(),
                on_progress=self.on_progress,
            )
        self.trace += registration.trace
        self.note("register", True, "pose of the face in the scan", f"rmse {registration.rmse_mm:.2f} mm")
        for step, ran, reason, evidence in registration.notes:
            self.note(f"register.{step}", ran, reason, evidence)
        return registration

    def albedo(
        self, image: GeometryImage, scan: RawScan, lights: int | str, brdf: str
    ) -> AlbedoEstimate | None:
        if "albedo" in self.skip:
            self.note("albedo", False, "skipped by the caller")
            return None
        if image.texture_linear is None:
            self.note("albedo", False, "the scan has no usable colour", "; ".join(scan.notes))
            return None
        with self.timed("albedo"):
            estimate = estimate_albedo(
                image,
                lights=lights,
                brdf=brdf,
                budget=self.share("albedo"),
                seed=self.seed,
                options=self.estimate_options(),
                on_progress=self.on_progress,
            )
        self.trace += estimate.trace
        self.plan += estimate.plan
        return estimate

    def registration_options(self) -> RegistrationOptions:
        options = self.quality.registration
        if "register.depth_annealing" in self.skip:
            return replace(options, annealing_evaluations=0)
        return replace(
            options, force_annealing=options.force_annealing or "register.depth_annealing" in self.force
        )

    def estimate_options(self) -> EstimateOptions:
        """Return the preset's options with the steps that the caller skips or forces."""
        options = self.quality.albedo
        return replace(
            options,
            shadows=self.choice("albedo.shadows", options.shadows),
            near_light=self.choice("albedo.near_light", options.near_light),
            roughness=self.choice("albedo.roughness", options.roughness),
            specular=self.choice("albedo.specular", options.specular),
            rectification=self.choice("albedo.rectification", options.rectification),
            inpainting=self.choice("albedo.inpainting", options.inpainting),
        )

    def choice(self, stage: str, preset: bool | None) -> bool | None:
        """Return False when skipped, True when forced, else the preset's: None lets the evidence decide."""
        if stage in self.skip:
            return False
        return True if stage in self.force else preset
