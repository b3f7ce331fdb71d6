"""`ProcessResult`: everything that came of one scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from scan2albedo.albedo import AlbedoEstimate
    from scan2albedo.core import GeometryImage, Plan, RawScan, Trace
    from scan2albedo.fitting import FittedFace
    from scan2albedo.registration import Registration


@dataclass(frozen=True)
class ProcessResult:
    """Everything that came of one scan.

    Parameters
    ----------
    scan : RawScan
    registration : Registration or None
        None without a model, or when registration was skipped.
    fitted : FittedFace or None
        None without a model.
    geometry_image : GeometryImage
    albedo : AlbedoEstimate or None
        None when the scan has no colour, or the stage was skipped.
    plan : Plan
        What ran, what was left out, and why.
    trace : Trace
        Error against run time of every iterative stage.
    timings_s : mapping of str to float
        Wall-clock seconds of each stage.
    options : mapping of str to object
        What `process` was called with.
    seed : int
    source : Path or None
        File the scan was read from.
    out : Path or None
        Folder with the files, when they were written.
    messages : tuple of str
        Warnings that stages gave.
    """

    scan: RawScan
    registration: Registration | None
    fitted: FittedFace | None
    geometry_image: GeometryImage
    albedo: AlbedoEstimate | None
    plan: Plan
    trace: Trace
    timings_s: Mapping[str, float]
    options: Mapping[str, Any]
    seed: int
    source: Path | None = None
    out: Path | None = None
    messages: tuple[str, ...] = ()

    def metrics(self) -> dict[str, Any]:
        """Return the figures of each stage, for summaries and result.json."""
        figures: dict[str, Any] = {"seconds": round(sum(self.timings_s.values()), 3)}
        if self.registration is not None:
            figures["registration"] = {
                "rmse_mm": self.registration.rmse_mm,
                "confidence": self.registration.confidence,
                "converged": self.registration.converged,
            }
        if self.fitted is not None:
            figures["fit"] = {**self.fitted.metrics, "converged": self.fitted.converged}
        figures["geometry_image"] = self.geometry_image.figures()
        if self.albedo is not None:
            figures["albedo"] = {
                "lights": len(self.albedo.lights),
                "parameters": dict(self.albedo.parameters),
                "converged": self.albedo.converged,
            }
            if self.albedo.uncertainty is not None:
                figures["albedo"]["uncertainty"] = self.albedo.uncertainty.figures()
        return figures

    def _unfinished(self) -> list[str]:
        """Return the stages that a budget ended, or that found no end of their own."""
        stages = {"register": self.registration, "fit": self.fitted, "albedo": self.albedo}
        return [name for name, found in stages.items() if found is not None and not found.converged]

    def summary(self) -> str:
        """Return one line a person can judge the result by."""
        parts = [f"{self.scan.name}: done in {sum(self.timings_s.values()):.1f} s"]
        if self.fitted is not None:
            parts.append(f"fit {np.nanmean(self.fitted.residual_mm):.2f} mm mean")
        if self.albedo is not None:
            lights = ", ".join(
                f"({np.degrees(light.azimuth_rad):.0f}, {np.degrees(light.elevation_rad):.0f}) deg"
                for light in self.albedo.lights
            )
            parts.append(f"light at {lights}" if lights else "no directed light")
        else:
            parts.append("no albedo (see the plan)")
        if unfinished := self._unfinished():
            parts.append(f"not converged: {', '.join(unfinished)}")
        if self.out is not None:
            parts.append(f"files in {self.out}")
        return "; ".join(parts)
