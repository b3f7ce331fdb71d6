"""`ProcessResult`: all results of one scan; and `Run`, the same while the stages are still at it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scan2albedo.core import OnProgress, Plan, PlanStep, RawScan, Trace
from scan2albedo.core.arrays import ByteArray, FloatArray, Texts, Values, attributes
from scan2albedo.core.raw_scan import lost_texture
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.report.overview import preview_srgb

if TYPE_CHECKING:
    from scan2albedo.albedo import AlbedoEstimate
    from scan2albedo.core import GeometryImage
    from scan2albedo.fitting import FittedFace
    from scan2albedo.fitting.linear_model import LinearModelFit
    from scan2albedo.geometry.loop_subdivision import SurfacePoints
    from scan2albedo.io.linear_model_files import LinearFaceModel
    from scan2albedo.pipeline.options import ProcessOptions
    from scan2albedo.registration import Registration
    from scan2albedo.templates import AnnotatedFaceModel
    from scan2albedo.unlit.light_removal import UnlitScan
    from scan2albedo.unlit.template_baking import TemplateTexture

SURE = 0.5
"""Confidence of a registration below which there is a doubt: whole faces have more."""


@dataclass(frozen=True)
class ProcessResult:
    """All results of one `scan`, with the `plan` and `trace` of its stages and the `seed` they had."""

    scan: RawScan
    registration: Registration | None
    """With the pose the fit ended with; None without a model, or when registration was skipped."""
    fitted: FittedFace | None
    """None without a model."""
    geometry_image: GeometryImage
    """The face, or the object, on its chart."""
    albedo: AlbedoEstimate | None
    """None when the scan has no colour, or the stage was skipped."""
    plan: Plan
    trace: Trace
    timings_s: Mapping[str, float]
    """Wall-clock seconds of each stage."""
    options: Mapping[str, Any]
    """What `process` was called with."""
    seed: int
    unlit: UnlitScan | None = None
    """The scan itself without its light, where it was asked for."""
    template: TemplateTexture | None = None
    """The model's own template with its texture, where it has coordinates and the scan has colour."""
    maps_of_skin: TemplateTexture | None = None
    """A mesh with the maps of a skin material, where they were asked for; see `engine_maps`."""
    linear_model: LinearModelFit | None = None
    """Coefficients of a linear model, where they were asked for; its mesh is the `template`."""
    source: Path | None = None
    """File the scan was read from."""
    out: Path | None = None
    """Folder with the files, when they were written."""
    input_sha256: str | None = None
    """Of the file and those it refers to, before they were read (`io.input_sha256`); None without a file."""

    @property
    def notes(self) -> Texts:
        """What loading decided and repaired, and what is doubtful or wrong, one sentence each."""
        return (*self.scan.notes, *(step.text for step in self.plan.doubts()))

    @property
    def landmarks_scan(self) -> FloatArray | None:
        """(68, 3): the fit's landmarks in the scan's own frame and unit; None without a fit or landmarks."""
        if self.fitted is None or self.fitted.landmarks is None:
            return None
        in_mm = transform_points(invert_rigid(self.fitted.model_from_scan), self.fitted.landmarks)
        return in_mm / self.scan.mm_per_unit

    @property
    def expected_error(self) -> float | None:
        """Relative error of the albedo that is expected of half the texels, or of more; None without one."""
        if self.albedo is None or self.albedo.expected_error is None:
            return None
        return float(np.median(self.albedo.expected_error[self.albedo.image.mask]))

    @cached_property
    def preview_srgb(self) -> ByteArray | None:
        """(H, W, 3): the albedo as it is shown, white outside the mask; None without one."""
        if self.albedo is None:
            return None
        return preview_srgb(self.albedo.albedo_linear, self.geometry_image.mask)

    @cached_property
    def texture_srgb(self) -> ByteArray | None:
        """(H, W, 3): the same, but colours go on beyond the mask: viewers that filter mix in no white."""
        if self.preview_srgb is None:
            return None
        return filled_from_nearest(self.preview_srgb, self.geometry_image.mask).astype(np.uint8)

    def write_more(self, folder: Path) -> None:
        """Write what a scan alone has not."""

    def metrics(self) -> Values:
        """Return the figures of each stage, for summaries and result.json."""
        figures: Values = {"seconds": round(sum(self.timings_s.values()), 3)}
        if self.registration is not None:
            figures["registration"] = attributes(self.registration, "rmse_mm", "confidence", "converged")
        if self.fitted is not None:
            figures["fit"] = {**self.fitted.metrics, "converged": self.fitted.converged}
        if (linear := self.linear_model) is not None:
            figures["linear_model"] = {
                **attributes(linear, "noise_mm", "observations", "converged"),
                "residual_mean_mm": float(np.nanmean(linear.residual_mm)),
            }
        figures["geometry_image"] = self.geometry_image.figures()
        if self.albedo is not None:
            found = self.albedo
            figures["albedo"] = {"lights": len(found.lights), "parameters": dict(found.parameters)}
            figures["albedo"]["converged"] = found.converged
            if self.expected_error is not None:
                figures["albedo"]["expected_error"] = self.expected_error
            if found.uncertainty is not None:
                figures["albedo"]["uncertainty"] = found.uncertainty.figures()
        return figures

    def summary(self) -> str:
        """Return a summary of one line for a person."""
        parts = [f"{self.scan.name}: done in {sum(self.timings_s.values()):.1f} s"]
        if self.fitted is not None:
            parts.append(f"fit {np.nanmean(self.fitted.residual_mm):.2f} mm mean")
        if self.albedo is not None:
            lights = ", ".join(
                f"({np.degrees(light.azimuth_rad):.0f}, {np.degrees(light.elevation_rad):.0f}) deg"
                for light in self.albedo.lights
            )
            soft = "soft light" if self.albedo.environment is not None else "no directed light"
            parts.append(f"light at {lights}" if lights else soft)
            if self.expected_error is not None:
                parts.append(f"albedo +- {100 * self.expected_error:.0f} % a texel")
        else:
            parts.insert(1, f"no albedo: {lost_texture(self.scan.notes) or 'see the plan'}")
        if self.registration is not None and self.registration.confidence < SURE:
            parts.append(f"pose unsure (confidence {self.registration.confidence:.2f})")
        if any(step.stage == "texture" for step in self.plan.doubts()):
            parts.append("texture doubtful")
        stages = {"register": self.registration, "fit": self.fitted, "albedo": self.albedo}
        if unfinished := [name for name, found in stages.items() if found and not found.converged]:
            parts.append(f"not converged: {', '.join(unfinished)}")
        if self.out is not None:
            parts.append(f"files in {self.out}")
        return "; ".join(parts)


@dataclass
class Run:
    """One scan on its way through the stages, which fill in what they find, named as in `ProcessResult`."""

    source: str | Path | RawScan
    options: ProcessOptions
    name: str | None = None
    """Of the scan, where the caller gave one."""
    on_progress: OnProgress = None
    plan: dict[str, list[PlanStep]] = field(default_factory=dict)
    """Rows of the plan by stage."""
    scan: RawScan = field(init=False)
    input_sha256: str | None = None
    size_fits: bool | None = None
    """Whether the scan is as long as a head in some unit; None where the caller gave the unit."""
    model: AnnotatedFaceModel | None = None
    linear: tuple[LinearFaceModel, SurfacePoints] | None = None
    """The linear model to fit, and the places of its vertices on `model`."""
    registration: Registration | None = None
    fitted: FittedFace | None = None
    geometry_image: GeometryImage = field(init=False)
    linear_model: LinearModelFit | None = None
    albedo: AlbedoEstimate | None = None
    unlit: UnlitScan | None = None
    template: TemplateTexture | None = None
    maps_of_skin: TemplateTexture | None = None

    @property
    def file(self) -> Path | None:
        """The scan's file; None for a scan in memory."""
        return None if isinstance(self.source, RawScan) else Path(self.source)

    def result(self, timings_s: Mapping[str, float]) -> ProcessResult:
        """Return the result of all stages, which took these seconds."""
        searches = (self.registration, self.fitted, self.linear_model, self.albedo)
        loaded = (PlanStep("load", True, note) for note in self.scan.notes)
        shared = {own.name for own in fields(self)} & {one.name for one in fields(ProcessResult)}
        found: Values = {
            **attributes(self, *shared),
            "plan": Plan((*loaded, *chain(*self.plan.values()))),
            "trace": sum((search.trace for search in searches if search is not None), Trace()),
            "timings_s": timings_s,
            "options": self.options.recorded(self.model),
            "seed": self.options.seed,
            "source": self.file,
        }
        return ProcessResult(**found)
