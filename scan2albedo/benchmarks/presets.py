"""The presets of quality as settings of the sweeps."""

from __future__ import annotations

from typing import Any

from scan2albedo.benchmarks.sweep import Setting

STANDARD = "standard"
GLASSES: dict[str, dict[str, Any]] = {
    "draft": {"outlines": 2, "steps": 5, "outline_stride": 2},
    "best": {"outline_correlation_px": 40.0},
}
WEIGHTS: dict[str, dict[str, Any]] = {
    "draft": {"tolerance": 1e-4, "finest": 1 / 85},
    "best": {"coarsest": 1 / 150, "max_nodes": 20_000},
}
"""Fields that differ from the defaults, of stages that `process` does not have; `quality.PRESETS` has the
others'."""


def preset_settings(stage: str) -> list[Setting]:
    """Return the presets of a stage as settings, short of those that leave it at its default."""
    if stage in ("glasses", "weights"):
        named = _own_presets(stage)
    else:
        from scan2albedo.pipeline.quality import PRESETS

        standard = _of_process(stage, PRESETS[STANDARD])
        every = {name: _of_process(stage, quality) for name, quality in PRESETS.items()}
        named = {name: options for name, options in every.items() if options != standard}
    return [Setting("preset", name, options) for name, options in named.items()]


def _of_process(stage: str, quality: Any) -> Any:
    """Return what a quality holds for a stage of `process`."""
    if stage == "geometry_image":
        from scan2albedo.benchmarks.sampling import SizeOptions

        return SizeOptions(quality.size)
    return {"register": quality.registration, "fit": quality.fit, "albedo": quality.albedo}[stage]


def _own_presets(stage: str) -> dict[str, Any]:
    if stage == "glasses":
        from scan2albedo.eyeglasses import FaceRegistrationOptions

        return {name: FaceRegistrationOptions(**fields) for name, fields in GLASSES.items()}
    from scan2albedo.benchmarks.weights import SpacingOptions
    from scan2albedo.eyeglasses.weighting.options import WeightOptions

    return {name: SpacingOptions(options=WeightOptions(**fields)) for name, fields in WEIGHTS.items()}
