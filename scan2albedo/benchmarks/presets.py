"""What quality "draft", "standard" and "best" mean for each stage: points of the measured fronts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from scan2albedo.benchmarks.sweep import Setting

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "register": {
        "draft": {"anchor_spacing_mm": 60.0, "kept_starts": 60, "candidates": 2, "settling_iterations": 10},
        "best": {"scan_spacing_mm": 3.0, "model_spacing_mm": 4.0},
    },
    "fit": {
        "draft": {"steps": 2},
        "best": {"levels": (0, 0, 0) + (1,) * 9},
    },
    "geometry_image": {"draft": {"size": 256}, "best": {"size": 1024}},
    "albedo": {
        "draft": {"sizes": (32, 64), "start_directions": 20},
        "best": {"sizes": (64, 256), "starts": 6, "descent_iterations": 20},
    },
    "weights": {"draft": {"tolerance": 1e-4, "finest": 1 / 85}, "best": {"thin_part": 0.02}},
    "glasses": {
        "draft": {"outlines": 2, "steps": 5, "outline_stride": 2},
        "best": {"outlines": 20, "steps": 80},
    },
}
"""Fields of each stage's options that differ from the defaults; standard is the default."""


def _options(stage: str, fields: dict[str, Any]) -> Any:
    """Return what a stage's settings hold, with some fields changed."""
    if stage == "geometry_image":
        from scan2albedo.benchmarks.sampling import SizeOptions

        return SizeOptions(**fields)
    if stage == "weights":
        from scan2albedo.benchmarks.weights import SpacingOptions
        from scan2albedo.eyeglasses.weighting.options import WeightOptions

        return SpacingOptions(options=WeightOptions(**fields))
    from scan2albedo.albedo import EstimateOptions
    from scan2albedo.eyeglasses import FaceRegistrationOptions
    from scan2albedo.fitting import FitOptions
    from scan2albedo.registration import RegistrationOptions

    known: dict[str, Callable[..., Any]] = {
        "register": RegistrationOptions,
        "fit": FitOptions,
        "albedo": EstimateOptions,
        "glasses": FaceRegistrationOptions,
    }
    return known[stage](**fields)


def preset_settings(stage: str) -> list[Setting]:
    """Return the presets of a stage as settings; the standard one is the default and left out."""
    named = PRESETS.get(stage, {})
    return [Setting("preset", name, _options(stage, fields)) for name, fields in named.items()]
