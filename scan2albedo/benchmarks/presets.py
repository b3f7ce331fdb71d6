"""What quality "draft", "standard" and "best" mean for each stage: points of the measured fronts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from scan2albedo.benchmarks.sweep import Setting

PRESETS: dict[str, dict[str, dict[str, Any]]] = {}
"""Fields of each stage's options that differ from the defaults; standard is the default."""


def _options(stage: str) -> Callable[..., Any]:
    """Return the options dataclass of a stage."""
    from scan2albedo.albedo import EstimateOptions
    from scan2albedo.fitting import FitOptions
    from scan2albedo.registration import RegistrationOptions

    known: dict[str, Callable[..., Any]] = {
        "register": RegistrationOptions,
        "fit": FitOptions,
        "albedo": EstimateOptions,
    }
    return known[stage]


def preset_settings(stage: str) -> list[Setting]:
    """Return the presets of a stage as settings; the standard one is the default and left out."""
    named = PRESETS.get(stage, {})
    return [Setting("preset", name, _options(stage)(**fields)) for name, fields in named.items()]
