"""What `process` is called with, in one place for every caller that passes it on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from scan2albedo.core import Budget
from scan2albedo.pipeline.quality import quality_of


@dataclass(frozen=True, kw_only=True)
class ProcessOptions:
    """The options of `pipeline.process`, by the same names; see there.

    Parameters
    ----------
    model : str
        "default", "none", or the file of a model or of a template.
    size : int, optional
    lights : "auto" or int
    brdf, unit, quality : str
    budget : Budget, float or None
    seed : int
    skip, force : sequence of str
    pictures : bool

    Raises
    ------
    ValueError
        For a choice that `process` would refuse.

    Examples
    --------
    >>> ProcessOptions(size=128).arguments()["size"]
    128
    """

    model: str = "default"
    size: int | None = None
    lights: int | str = "auto"
    brdf: str = "oren-nayar"
    unit: str = "auto"
    quality: str = "standard"
    budget: Budget | float | None = None
    seed: int = 0
    skip: tuple[str, ...] = ()
    force: tuple[str, ...] = ()
    pictures: bool = True

    def __post_init__(self) -> None:
        # Imported here: it loads compiled code, which a process that only passes options on need not have.
        from scan2albedo.pipeline.choices import check_choices, check_stage_names

        object.__setattr__(self, "model", str(self.model))
        object.__setattr__(self, "budget", Budget.of(self.budget))
        object.__setattr__(self, "skip", tuple(self.skip))
        object.__setattr__(self, "force", tuple(self.force))
        check_stage_names(self.skip, self.force)
        check_choices(self.texels, self.lights, self.brdf, self.unit)
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}, expected a whole number >= 0")

    @property
    def texels(self) -> int:
        """Height and width of the geometry image: as asked for, or that of the preset."""
        return quality_of(self.quality).size if self.size is None else self.size

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments of `process`."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def plain(self) -> Mapping[str, Any]:
        """Return the options in JSON's own types."""
        return asdict(self)
