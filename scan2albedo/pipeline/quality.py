"""Named presets of quality: the options of each stage of `process`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from scan2albedo.albedo import EstimateOptions
from scan2albedo.core.geometry_image import check_size
from scan2albedo.fitting.options import FitOptions
from scan2albedo.registration import RegistrationOptions


@dataclass(frozen=True)
class Quality:
    """Options of every stage of `process`.

    A preset with one option changed, for ``process(..., quality=softer)``:

    >>> from dataclasses import replace
    >>> standard = PRESETS["standard"]
    >>> softer = replace(standard, name="softer", fit=replace(standard.fit, tangential=0.05))
    >>> softer.size
    512
    """

    name: str
    """What results call it."""
    size: int = 512
    """Height and width of the geometry image in texels, where the caller asks for none."""
    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    albedo: EstimateOptions = field(default_factory=EstimateOptions)
    """`registration`, `fit` and `albedo` are what the stages are called with."""

    def __post_init__(self) -> None:
        check_size(self.size)


PRESETS: Mapping[str, Quality] = MappingProxyType(
    {
        "draft": Quality(
            "draft",
            size=256,
            registration=RegistrationOptions(
                anchor_spacing_mm=50.0, kept_starts=60, candidates=4, settling_iterations=10
            ),
            fit=FitOptions(levels=(0, 0, 1), finest_level=0),
            albedo=EstimateOptions(
                sizes=(32, 32, 64), start_directions=30, descent_iterations=8, maximal_lights=2
            ),
        ),
        "standard": Quality("standard"),
        # The steps of standard: finer ones changed no error beyond the spread between scans.
        "best": Quality("best", size=1024),
    }
)
"""The presets by name; `tools/bench_quality.py` measures each one's error and time."""


def quality_of(choice: Quality | str) -> Quality:
    """Return a preset by its name, or the qualities given; raises `ValueError` for an unknown name."""
    if isinstance(choice, Quality):
        return choice
    if choice not in PRESETS:
        raise ValueError(f"quality is {choice!r}, expected one of {', '.join(PRESETS)}")
    return PRESETS[choice]
