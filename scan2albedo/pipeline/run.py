"""One scan on its way through the stages: clock, budget, plan and trace."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from scan2albedo.albedo import AlbedoEstimate, EstimateOptions, estimate_albedo
from scan2albedo.core import Budget, GeometryImage, Plan, PlanStep, ProgressCallback, RawScan, Trace
from scan2albedo.face_model import AnnotatedFaceModel, chosen_model
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.geometry_image import geometry_image, geometry_image_of_scan
from scan2albedo.io import load_scan
from scan2albedo.pipeline.quality import Quality
from scan2albedo.pipeline.result import ProcessResult
from scan2albedo.registration import Registration, RegistrationOptions, register

BUDGET_SHARES = {"register": 0.25, "fit": 0.4, "albedo": 0.9}
"""Share of the seconds still left for searching that each stage may take."""
WHOLE_FACE = 0.8
"""Part of the model with scan near, below which a person is told: whole faces have 0.85 and more."""
SAMPLING_S, DIVISION_S = 3e-6, 2e-6
"""Seconds a texel that a geometry image and the removal of its light take, whatever the budget."""


@dataclass
class PipelineRun:
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
        """Time the block as a stage."""
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
        if fitted is not None:
            messages += _cautions(fitted)
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
        """Add a row to the plan."""
        self.plan += Plan((PlanStep(stage, ran, reason, evidence),))

    def geometry(
        self, scan: RawScan, model: AnnotatedFaceModel | None
    ) -> tuple[Registration | None, FittedFace | None, GeometryImage]:
        """Register, fit and sample; without a model, chart and sample."""
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
        """Register, unless the caller says that the scan lies in place."""
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
        """Estimate the albedo, unless skipped or there is no colour."""
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
        """Return the preset's options with the steps that the caller skips or forces."""
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


def _cautions(fitted: FittedFace) -> list[str]:
    """Return what the user has to be told of a fit that looks good where there was a scan."""
    coverage = fitted.metrics["coverage"]
    if coverage >= WHOLE_FACE:
        return []
    return [
        f"only {100 * coverage:.0f} % of the face has scan near it, the rest is the model's own shape: is "
        "the file cut short, or is it half a face?"
    ]


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
