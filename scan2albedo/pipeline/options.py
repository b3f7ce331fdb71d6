"""The options of `process`, written once: keyword arguments, flags of commands, and what results record."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import Field, asdict, dataclass, field, fields
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scan2albedo.core import Budget, checked_seed
from scan2albedo.core.landmarks import AUTO, landmarks_option

if TYPE_CHECKING:
    from scan2albedo.pipeline.quality import Quality
    from scan2albedo.templates import AnnotatedFaceModel

FORCEABLE = (
    "register.depth_annealing",
    "albedo.shadows",
    "albedo.lamp_size",
    "albedo.cameras",
    "albedo.specular",
    "albedo.near_light",
    "albedo.roughness",
    "albedo.occlusion",
    "albedo.bounce",
    "albedo.environment",
    "albedo.light_colour",
    "albedo.outlines",
    "albedo.rectification",
    "albedo.inpainting",
)
"""Steps that the evidence may leave out: the names that `force` takes."""

STAGES = ("register", "fit", "geometry_image", "albedo", *FORCEABLE)
"""Names of stages and of the steps inside them: the names that `skip` takes."""

_NEEDED = {"fit", "geometry_image"}


def _option(default: Any, flag: Any, help: str, **limits: Any) -> Any:
    """Return a field with its type on the command line, its help there and typer's limits."""
    return field(default=default, metadata={"flag": flag, "help": help, **limits})


@dataclass(frozen=True, kw_only=True)
class ProcessOptions:
    """How `process` takes a scan through its stages.

    Raises ValueError for an unknown stage, BRDF, unit or quality, a stage that cannot be skipped or forced,
    or is both, a size or number of lights out of range, an invalid seed or budget.
    """

    model: AnnotatedFaceModel | str | Path | None = _option(
        "default",
        str,
        "A model's JSON file; a template's mesh; 'default'; or 'none' for an object without a face.",
    )
    """The template, or its file (`AnnotatedFaceModel.from_mesh`); None is "default". "none" processes any
    object without a face: xatlas charts, no registration, no fit."""
    size: int | None = _option(
        None, int | None, "Height and width of the geometry image in texels; else 512, 256 in drafts.", min=8
    )
    """Height and width of the geometry image; that of `quality` when omitted."""
    lights: int | str = _option("auto", str, "'auto', or how many.")
    """Lamps, 1 to 4; "auto" decides by evidence, and may find none."""
    brdf: str = _option("oren-nayar", str, "oren-nayar, lambert, minnaert or spherical-harmonics.")
    unit: str = _option("auto", str, "auto, mm, cm or m.")
    quality: Quality | str = _option(
        "standard", str, "draft, standard, or best: standard with 1024 texels a side."
    )
    """`brdf`, `unit`, `quality`: one of these names; `quality` also the options of every stage."""
    budget: Budget | float | None = _option(None, float | None, "Seconds a scan may take.")
    """Seconds for the whole run, or a Budget whose evaluations hold for each stage."""
    seed: int = _option(0, int, "Seed of every random step.", min=0)
    """Same seed, input and budget in evaluations: same result, bit by bit."""
    skip: Sequence[str] = _option((), list[str] | None, "A stage to leave out; may be repeated.")
    """Names from `STAGES`."""
    force: Sequence[str] = _option(
        (),
        list[str] | None,
        "An optional step to carry out in any case, such as albedo.shadows; may be repeated.",
    )
    """Names from `FORCEABLE`: steps to carry out whatever the evidence says, where there is anything to do (a
    shadow's outline to rectify, a saturated texel to inpaint)."""
    pictures: bool = _option(True, bool, "Draw overview.png and error_vs_time.png among the files.")
    """Whether these are drawn."""
    files: str = _option(
        "standard", str, "minimal: without pictures, EXR of the geometry image and light; standard; or all."
    )
    """Which files are written: "standard"; "minimal" leaves out what other files have, and pictures; "all"
    also has the unlit scan."""
    textures: str | Path | None = _option(
        None, str | None, "Folder from which textures may be read beside the scan's own.", metavar="DIR"
    )
    """Folder from which materials and textures may be read beside the scan's own; see `load_scan`."""
    landmarks: Any = _option(
        None,
        str | None,
        "Landmarks placed by hand, any of 68: a CSV, JSON or MeshLab .pp file, or a folder with files named "
        "after the scans; or auto for those that MediaPipe finds (needs the extra named landmarks).",
        metavar="FILE|auto",
    )
    """Points that someone placed on the scan, soft constraints of registration and fit, see `load_scan`; or
    "auto": of the fit alone, see `detected_landmarks`."""

    unlit: str | None = _option(
        None,
        str | None,
        "Also write the scan itself without its light: 'face', or 'all' of it with the same lamps.",
        metavar="face|all",
    )
    """Also the scan itself, its own vertices, coordinates and texels, without its light; see `unlit_scan`."""
    texture_size: int = _option(
        1024, int, "Height and width of the texture on your own template's coordinates, up to 8192.", min=8
    )
    """Height and width of each tile of `template_texture`, where the model's template has coordinates."""

    def __post_init__(self) -> None:
        if self.model is None or isinstance(self.model, Path):
            object.__setattr__(self, "model", str(self.model or "default"))
        if isinstance(self.textures, Path):
            object.__setattr__(self, "textures", str(self.textures))
        if isinstance(self.landmarks, Path):
            object.__setattr__(self, "landmarks", str(self.landmarks))
        object.__setattr__(self, "landmarks", landmarks_option(self.landmarks))
        if self.files == "all" and self.unlit is None:
            object.__setattr__(self, "unlit", "face")
        object.__setattr__(self, "budget", Budget.of(self.budget))
        object.__setattr__(self, "skip", tuple(self.skip))
        object.__setattr__(self, "force", tuple(self.force))
        checked_seed(self.seed)
        _check_stages(self.skip, self.force)
        self._check_ranges()

    def _check_ranges(self) -> None:
        """Refuse values that a late stage would refuse, before an early one has run."""
        # Imported here: they load compiled code, which the command line does not need to show its help.
        from scan2albedo.albedo.estimate import BRDFS
        from scan2albedo.applications.light_removal import REACHES
        from scan2albedo.applications.template_baking import LARGEST_TEXTURE
        from scan2albedo.core.geometry_image import LARGEST_SIZE, SMALLEST_SIZE
        from scan2albedo.io.units import MM_PER_UNIT

        size = self.texels
        if not isinstance(size, Integral) or not SMALLEST_SIZE <= size <= LARGEST_SIZE:
            raise ValueError(
                f"size is {size!r}, expected a whole number from {SMALLEST_SIZE} to {LARGEST_SIZE}"
            )
        size, most = self.texture_size, LARGEST_TEXTURE
        if not isinstance(size, Integral) or not 8 <= size <= most:
            raise ValueError(f"texture_size is {size!r}, expected a whole number from 8 to {most}")
        if self.files not in ("minimal", "standard", "all"):
            raise ValueError(f"files is {self.files!r}, expected one of minimal, standard, all")
        if self.unlit not in (None, *REACHES):
            raise ValueError(f"unlit is {self.unlit!r}, expected one of {', '.join(REACHES)}, or None")
        if self.lights != "auto" and not (isinstance(self.lights, Integral) and 1 <= self.lights <= 4):
            raise ValueError(f"lights is {self.lights!r}, expected 'auto' or a whole number from 1 to 4")
        if self.brdf not in BRDFS:
            raise ValueError(f"brdf is {self.brdf!r}, expected one of {', '.join(BRDFS)}")
        if self.unit != "auto" and self.unit not in MM_PER_UNIT:
            raise ValueError(f"unit is {self.unit!r}, expected one of auto, {', '.join(MM_PER_UNIT)}")

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
        from scan2albedo.pipeline.quality import quality_of

        return quality_of(self.quality)

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments of `process`."""
        return {option.name: getattr(self, option.name) for option in fields(self)}

    def plain(self) -> Mapping[str, Any]:
        """Return the options in JSON's own types."""
        return asdict(self)

    def recorded(self, model: AnnotatedFaceModel | None) -> dict[str, Any]:
        """Return the options as `result.json` has them, defaults replaced by the values used."""
        budget = Budget.of(self.budget)
        return {
            **{name: value for name, value in self.arguments().items() if name not in _RECORDED_OTHERWISE},
            "model": "none" if model is None else model.name,
            "landmarks": self.landmarks if isinstance(self.landmarks, str | None) else "given",
            "size": self.texels,
            "quality": self.stages.name,
            "skip": sorted(set(self.skip)),
            "force": sorted(set(self.force)),
            "budget_seconds": budget.seconds,
            "budget_evaluations": budget.evaluations,
        }


_RECORDED_OTHERWISE = ("budget", "seed", "pictures", "files")


def process_options() -> tuple[Field[Any], ...]:
    """Return the fields of `ProcessOptions`; metadata hold `flag` (the type), `help` and typer's limits."""
    return fields(ProcessOptions)


def option_of_text(name: str, text: str) -> int | str:
    """Return an option given as text (a seed, or a number of lights) as a number where it is one.

    >>> option_of_text("lights", "2"), option_of_text("lights", "auto")
    (2, 'auto')
    """
    if name in ("seed", "lights") and re.fullmatch("-?[0-9]+", text):
        return int(text)
    return text


def _check_stages(skip: Sequence[str], force: Sequence[str]) -> None:
    """Refuse names that are no stage, or that cannot be skipped or forced."""
    for name in (*skip, *force):
        if name not in STAGES:
            raise ValueError(f"{name!r} is no stage; stages are {', '.join(STAGES)}")
    if needed := sorted(set(skip) & _NEEDED):
        raise ValueError(
            f"{needed[0]!r} cannot be skipped: later stages stand on it (model='none' works without)"
        )
    for name in force:
        if name not in FORCEABLE:
            raise ValueError(
                f"{name!r} cannot be forced: no evidence leaves it out; "
                f"what can be forced is {', '.join(FORCEABLE)}"
            )
        if without := {name, name.partition(".")[0]} & set(skip):
            raise ValueError(f"{name!r} is forced, but {min(without)!r} is skipped; choose one")
