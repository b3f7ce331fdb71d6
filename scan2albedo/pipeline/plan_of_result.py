"""The plan of a result: which stages ran, which were left out, and why."""

from __future__ import annotations

import numpy as np

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.core import GeometryImage, Plan, PlanStep, RawScan
from scan2albedo.fitting import FittedFace
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.registration import Registration


def plan_of(
    options: ProcessOptions,
    scan: RawScan,
    registration: Registration | None,
    fitted: FittedFace | None,
    image: GeometryImage,
    estimate: AlbedoEstimate | None,
) -> Plan:
    """Return what ran, what was left out, and why."""
    steps: list[PlanStep] = []
    if registration is not None:
        evidence = f"rmse {registration.rmse_mm:.2f} mm"
        steps.append(PlanStep("register", True, "pose of the face in the scan", evidence))
        steps += registration.plan
    elif fitted is not None:
        reason = "skipped by the caller: the scan is taken to lie in the model's frame"
        steps.append(PlanStep("register", False, reason))
    if fitted is not None:
        if scan.landmarks is not None:
            reason = "MediaPipe finds landmarks" if options.landmarks_detected else "landmarks are given"
            steps.append(PlanStep("fit.landmarks", True, reason, f"{int(scan.landmarks.placed.sum())}"))
        evidence = f"{np.nanmean(fitted.residual_mm):.3f} mm mean"
        steps.append(PlanStep("fit", True, "the model is deformed onto the scan", evidence))
        steps += [_covers_step(options, fitted), _colors_step(scan, fitted)]
    else:
        steps += [PlanStep(stage, False, "no model was asked for") for stage in ("register", "fit")]
    figures = image.figures()
    evidence = (
        f"{figures['coverage']:.1%} of the texels used, {figures['texel_area_mm2']:.2f} mm2 each, "
        f"areas within a factor of {figures['texel_area_p95_to_p5']:.1f} (5 to 95 %)"
    )
    if fitted is not None and scan.has_color:
        evidence += f", texture seen in {figures['seen']:.1%} of them, {figures['skin']:.1%} of them skin"
    chart = "charts cut by xatlas" if fitted is None else "the model's own chart"
    steps.append(PlanStep("geometry_image", True, chart, evidence))
    if estimate is not None:
        return Plan(tuple(steps)) + estimate.plan
    if "albedo" in options.skip:
        return Plan((*steps, PlanStep("albedo", False, "skipped by the caller")))
    return Plan((*steps, PlanStep("albedo", False, "the scan has no usable colour", "; ".join(scan.notes))))


def _covers_step(options: ProcessOptions, fitted: FittedFace) -> PlanStep:
    """Return whether anything before the eyes was left out of the scan, and why."""
    if (area_mm2 := fitted.metrics["covered_mm2"]) > 0:
        reason = "some of the scan stands far before the eyes, as glasses do"
        return PlanStep("fit.covers", True, reason, f"{area_mm2 / 100:.0f} cm2 left out")
    if not options.stages.fit.covers:
        return PlanStep("fit.covers", False, "the preset keeps all of the scan")
    if fitted.landmarks is None:
        return PlanStep("fit.covers", False, "the model has no landmarks that say where eyes are")
    return PlanStep("fit.covers", False, "nothing is found before the eyes")


def _colors_step(scan: RawScan, fitted: FittedFace) -> PlanStep:
    """Return whether the scan's colours drew the model's brows, eyes and lips, and why."""
    if count := int(fitted.metrics.get("painted_landmarks", 0)):
        reason = "the scan's colours show brows, eyes or lips"
        return PlanStep("fit.colors", True, reason, f"{count} landmarks")
    reason = "the scan's colours show no feature surely" if scan.has_color else "the scan has no colour"
    return PlanStep("fit.colors", False, reason)
