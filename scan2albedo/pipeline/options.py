"""The options of `process`, and the named presets of quality: the options of each of its stages."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Integral
from pathlib import Path
from types import MappingProxyType
from typing import Any

from scan2albedo.albedo import OPTIONAL_STEPS, EstimateOptions
from scan2albedo.albedo.estimate import BRDFS
from scan2albedo.core import Budget, BudgetLike, checked_seed
from scan2albedo.core.arrays import Values
from scan2albedo.core.geometry_image import LARGEST_SIZE, SMALLEST_SIZE, check_size
from scan2albedo.core.landmarks import AUTO, landmarks_option
from scan2albedo.fitting.options import FitOptions
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.io.units import MM_PER_UNIT
from scan2albedo.pipeline.white_balance import checked_white_balance
from scan2albedo.registration import RegistrationOptions
from scan2albedo.templates import AnnotatedFaceModel
from scan2albedo.unlit.engine_maps import CARRIERS
from scan2albedo.unlit.light_removal import REACHES
from scan2albedo.unlit.template_baking import LARGEST_TEXTURE

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


@dataclass(frozen=True, kw_only=True)
class ProcessOptions:
    """How `process` takes a scan through its stages.

    Numbers of `seed` and `lights` may be text, paths `Path` or text.

    Raises ValueError for an unknown stage, BRDF, unit or quality, a stage that cannot be skipped or forced,
    or is both, a size or number of lights out of range, an invalid seed or budget.
    """

    model: AnnotatedFaceModel | str | Path | None = "default"
    """The template, or its file (`AnnotatedFaceModel.from_mesh`); None is "default". "none" processes any
    object without a face: xatlas charts, no registration, no fit."""
    size: int | None = None
    """Height and width of the geometry image in texels; that of `quality` when omitted."""
    lights: int | str = "auto"
    """Lamps, 1 to 4; "auto" decides by evidence, and may find none."""
    brdf: str = "oren-nayar"
    """Or "lambert", "minnaert", "spherical-harmonics"."""
    unit: str = "auto"
    """Of the scan's file: "auto", "mm", "cm" or "m"."""
    quality: Quality | str = "standard"
    """The options of every stage, or the name of a preset: "draft", "standard", "best", "paper"."""
    budget: BudgetLike = None
    """Seconds for the whole run, or a Budget whose evaluations hold for each stage."""
    seed: int = 0
    """Same seed, input and budget in evaluations: same result, bit by bit."""
    skip: Sequence[str] = ()
    """Names from `STAGES`."""
    force: Sequence[str] = ()
    """Names from `STEPS`: steps to carry out whatever the evidence says, where there is anything to do (a
    saturated texel to inpaint)."""
    pictures: bool = True
    """Whether overview.png and error_vs_time.png are drawn."""
    files: str = "standard"
    """Which files are written: "standard"; "minimal" leaves out what other files have, and pictures; "all"
    also has the unlit scan."""
    textures: str | Path | None = None
    """Folder from which materials and textures may be read beside the scan's own; see `load_scan`."""
    landmarks: Any = None
    """Points that someone placed on the scan, soft constraints of registration and fit, see `load_scan`; or
    "auto": of the fit alone, see `detected_landmarks`."""
    unlit: str | None = None
    """Also the scan itself, its own vertices, coordinates and texels, without its light: "face", or "all" of
    it; see `unlit_scan`."""
    maps: str | None = None
    """Also a mesh with all maps of a skin material on the "chart", the "scan"'s own texture coordinates, or
    those of the model's "template"; see `engine_maps`."""
    texture_size: int = 1024
    """Height and width of `maps`, and of each tile of `template_texture`."""
    white_balance: str | Sequence[float] = "none"
    """Of the scan's colours, before its light is sought: "grey-skin" gives skin the mean colour of people's;
    or the linear colour (R, G, B) that something grey has in the scan, which is divided out."""
    linear_model: LinearFaceModel | str | Path | None = None
    """A linear (morphable) model, or its file, whose coefficients are fitted to the scan; `template` is then
    its mesh."""

    def __post_init__(self) -> None:
        given = {**vars(self), "landmarks": landmarks_option(self.landmarks)}
        for name, value in given.items():
            if isinstance(value, Path):
                given[name] = str(value)
            elif name in ("seed", "lights") and isinstance(value, str) and re.fullmatch("-?[0-9]+", value):
                given[name] = int(value)
        if self.files == "all" and self.unlit is None:
            given["unlit"] = "face"
        if self.model is None:
            given["model"] = "default"
        given |= {"budget": Budget.of(self.budget), "skip": tuple(self.skip), "force": tuple(self.force)}
        given["white_balance"] = checked_white_balance(self.white_balance)
        vars(self).update(given)
        checked_seed(self.seed)
        if not isinstance(self.quality, Quality) and self.quality not in PRESETS:
            raise ValueError(f"quality is {self.quality!r}, expected one of {', '.join(PRESETS)}")
        choices = {"files": ("minimal", "standard", "all"), "brdf": BRDFS, "unit": ("auto", *MM_PER_UNIT)}
        for name, names in choices.items():
            if (choice := getattr(self, name)) not in names:
                raise ValueError(f"{name} is {choice!r}, expected one of {', '.join(names)}")
        if self.linear_model is not None and self.model == "none":
            raise ValueError("linear_model needs the model of a face: leave model='none' out")
        if self.unlit not in (None, *REACHES):
            raise ValueError(f"unlit is {self.unlit!r}, expected one of {', '.join(REACHES)}, or None")
        if self.maps not in (None, *CARRIERS):
            raise ValueError(f"maps is {self.maps!r}, expected one of {', '.join(CARRIERS)}, or None")
        if self.lights != "auto" and not (isinstance(self.lights, Integral) and 1 <= self.lights <= 4):
            raise ValueError(f"lights is {self.lights!r}, expected 'auto' or a whole number from 1 to 4")
        sides = {"size": (self.texels, LARGEST_SIZE), "texture_size": (self.texture_size, LARGEST_TEXTURE)}
        for name, (size, most) in sides.items():
            if not isinstance(size, Integral) or not SMALLEST_SIZE <= size <= most:
                raise ValueError(f"{name} is {size!r}, expected an integer from {SMALLEST_SIZE} to {most}")
        for name in (*self.skip, *self.force):
            if name not in STAGES:
                raise ValueError(f"unknown stage {name!r}; stages are {', '.join(STAGES)}")
        if needed := {"fit", "geometry_image"} & set(self.skip):
            raise ValueError(
                f"{min(needed)!r} cannot be skipped: later stages need it (model='none' works without)"
            )
        for name in self.force:
            if name not in STEPS:
                raise ValueError(
                    f"{name!r} cannot be forced: no evidence leaves it out; "
                    f"what can be forced is {', '.join(STEPS)}"
                )
            if without := {name, name.partition(".")[0]} & set(self.skip):
                raise ValueError(f"{name!r} is forced, but {min(without)!r} is skipped; choose one")

    @property
    def texels(self) -> int:
        """Height and width of the geometry image: as asked for, or that of the preset."""
        return self.stages.size if self.size is None else self.size

    @property
    def landmarks_detected(self) -> bool:
        """Whether MediaPipe is to find landmarks; nothing is fitted to them without a model."""
        return isinstance(self.landmarks, str) and self.landmarks == AUTO and self.model != "none"

    @property
    def stages(self) -> Quality:
        """The options of every stage, by the preset."""
        return self.quality if isinstance(self.quality, Quality) else PRESETS[self.quality]

    def of_registration(self) -> RegistrationOptions:
        """Return the preset's options of registration with what the caller skips or forces."""
        stage, step = self.stages.registration, "register.depth_annealing"
        if step in self.skip:
            return replace(stage, annealing_evaluations=0)
        return replace(stage, force_annealing=True) if step in self.force else stage

    def of_albedo(self) -> EstimateOptions:
        """Return the preset's options of the albedo with the steps that the caller skips or forces."""
        stage, asked = self.stages.albedo, {*self.skip, *self.force}
        skip = [step for step in stage.skip if step not in asked]
        force = [step for step in stage.force if step not in asked]
        skip += [step for step in self.skip if step in OPTIONAL_STEPS]
        force += [step for step in self.force if step in OPTIONAL_STEPS]
        return replace(stage, skip=tuple(skip), force=tuple(force))

    def arguments(self) -> Values:
        """Return the keyword arguments of `process`."""
        return {option.name: getattr(self, option.name) for option in fields(self)}

    def recorded(self, model: AnnotatedFaceModel | None) -> Values:
        """Return the options as `result.json` has them, defaults replaced by the values used."""
        budget = Budget.of(self.budget)
        elsewhere = ("budget", "seed", "pictures", "files")
        return {
            **{name: value for name, value in self.arguments().items() if name not in elsewhere},
            "model": "none" if model is None else model.name,
            "linear_model": getattr(self.linear_model, "name", self.linear_model),
            "landmarks": self.landmarks if isinstance(self.landmarks, str | None) else "given",
            "size": self.texels,
            "quality": self.stages.name,
            "skip": sorted(set(self.skip)),
            "force": sorted(set(self.force)),
            "budget_seconds": budget.seconds,
            "budget_evaluations": budget.evaluations,
        }
