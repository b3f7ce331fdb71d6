"""The presets of quality as settings of the sweeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.sweep import Setting
from scan2albedo.eyeglasses import FaceRegistrationOptions
from scan2albedo.eyeglasses.weighting.embedding import WeightOptions
from scan2albedo.pipeline.quality import PRESETS

STANDARD = "standard"
GLASSES: dict[str, dict[str, Any]] = {
    "draft": {"outline_stride": 2},
    "best": {"outline_correlation_px": 40.0},
}
WEIGHTS: dict[str, dict[str, Any]] = {
    "draft": {"tolerance": 1e-4, "finest": 1 / 85},
    "best": {"coarsest": 1 / 150, "max_nodes": 20_000},
}
"""Fields that differ from the defaults, of stages that `process` does not have; `quality.PRESETS` has the
others'."""


@dataclass(frozen=True)
class SizeOptions:
    """What a geometry image is made with."""

    size: int = 512
    taps: int | None = None


@dataclass(frozen=True)
class SpacingOptions:
    """A lattice's spacing in mm, or "auto"."""

    spacing: str | float = "auto"
    options: WeightOptions = WeightOptions()


def preset_settings(stage: str) -> list[Setting]:
    """Return the presets of a stage as settings, short of those that leave it at its default."""
    if stage == "glasses":
        named: dict[str, Any] = {name: FaceRegistrationOptions(**fields) for name, fields in GLASSES.items()}
    elif stage == "weights":
        named = {name: SpacingOptions(options=WeightOptions(**fields)) for name, fields in WEIGHTS.items()}
    else:
        standard = _of_process(stage, PRESETS[STANDARD])
        every = {name: _of_process(stage, quality) for name, quality in PRESETS.items()}
        named = {name: options for name, options in every.items() if options != standard}
    return [Setting("preset", name, options) for name, options in named.items()]


def _of_process(stage: str, quality: Any) -> Any:
    """Return what a quality holds for a stage of `process`."""
    if stage == "geometry_image":
        return SizeOptions(quality.size)
    return {"register": quality.registration, "fit": quality.fit, "albedo": quality.albedo}[stage]
