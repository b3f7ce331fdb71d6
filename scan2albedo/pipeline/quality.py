"""The named presets of quality, and the names of the stages and steps that may be skipped or forced."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from scan2albedo.albedo import OPTIONAL_STEPS, EstimateOptions
from scan2albedo.core.geometry_image import check_size
from scan2albedo.fitting.options import FitOptions
from scan2albedo.registration import RegistrationOptions

STEPS = ("register.depth_annealing", *OPTIONAL_STEPS)
"""Steps that the evidence may leave out: the names that `force` takes."""
STAGES = ("register", "fit", "geometry_image", "albedo", "eyes", *STEPS)
"""Names of stages and of the steps inside them: the names that `skip` takes."""


@dataclass(frozen=True)
class Quality:
    """Options of every stage of `process`; `dataclasses.replace` makes others of those in `PRESETS`."""

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
            albedo=EstimateOptions(sizes=(32, 32, 64), maximal_lights=2),
        ),
        "standard": Quality("standard"),
        # The steps of standard: finer ones changed no error beyond the spread between scans.
        "best": Quality("best", size=1024),
        # The steps of Toderici et al. that measure worse than ours, for comparison.
        "paper": Quality(
            "paper",
            registration=RegistrationOptions(force_annealing=True),
            albedo=EstimateOptions(objective="albedo-deviation", sizes=(32, 64, 128), prior="stationary"),
        ),
    }
)
"""The presets by name; `tools/bench/pipeline.py` measures each one's error and time."""
