"""The presets of quality as settings of the sweeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.sweep import Setting
from scan2albedo.eyeglasses.embedding import MAX_NODES
from scan2albedo.eyeglasses.weights import TOLERANCE
from scan2albedo.pipeline.options import PRESETS

STANDARD = "standard"
WEIGHTS: dict[str, dict[str, Any]] = {
    "draft": {"tolerance": 1e-4},
    "best": {"max_nodes": 20_000},
}
"""Fields that differ from the defaults, of stages that `process` does not have; `quality.PRESETS` has the
others'."""


@dataclass(frozen=True)
class SizeOptions:
    """What a geometry image is made with."""

    size: int = 512


@dataclass(frozen=True)
class SpacingOptions:
    """A lattice's spacing in mm, or "auto", and the limits of `solve_weights`."""

    spacing: str | float = "auto"
    max_nodes: int = MAX_NODES
    tolerance: float = TOLERANCE

    def limits(self) -> dict[str, Any]:
        return {"max_nodes": self.max_nodes, "tolerance": self.tolerance}


def preset_settings(stage: str) -> list[Setting]:
    """Return the presets of a stage as settings, short of those that leave it at its default."""
    if stage == "weights":
        named: dict[str, Any] = {name: SpacingOptions(**fields) for name, fields in WEIGHTS.items()}
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
