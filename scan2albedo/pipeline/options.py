"""`ProcessOptions`: the options of `process`, each written once: for Python, the shell, and their help.

Nothing heavy is imported here: the command line reads the options before it knows what to do.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypedDict

from scan2albedo.core import Budget, checked_seed
from scan2albedo.core.arrays import Values
from scan2albedo.core.geometry_image import LARGEST_SIZE, SMALLEST_SIZE
from scan2albedo.core.landmarks import AUTO, landmarks_option

if TYPE_CHECKING:
    from scan2albedo.albedo import EstimateOptions
    from scan2albedo.core import BudgetLike
    from scan2albedo.io.linear_model_files import LinearFaceModel
    from scan2albedo.pipeline.quality import Quality
    from scan2albedo.registration import RegistrationOptions
    from scan2albedo.templates import AnnotatedFaceModel

BALANCES = ("none", "grey-skin")
"""White balances with a name."""


def option(default: Any, help: str, flag: Any = str, choices: Sequence[Any] = (), **shown: Any) -> Any:
    """Return a field of a dataclass of options that is a flag of the command line, too.

    `flag` is its type there, `help` what ``--help`` says, `shown` what else `typer.Option` takes; other
    values than `choices` are refused where there are some.
    """
    return field(default=default, metadata={"help": help, "flag": flag, "choices": choices, "shown": shown})


@dataclass(frozen=True, kw_only=True)
class ProcessOptions:
    """How `process` takes a scan through its stages.

    Numbers of `seed` and `lights` may be text, paths `Path` or text.

    Raises ValueError for an unknown stage, BRDF, unit or quality, a stage that cannot be skipped or forced,
    or is both, a size or number of lights out of range, an invalid seed or budget.
    """

    model: AnnotatedFaceModel | str | Path | None = option(
        "default", "A model's JSON file; a template's mesh; 'default'; or 'none' for an object, no face."
    )
    """The template, or its file (`AnnotatedFaceModel.from_mesh`); None is "default". "none" processes any
    object without a face: xatlas charts, no registration, no fit."""
    size: int | None = option(
        None,
        "Height and width of the geometry image in texels; else 512, in drafts 256, in best 1024.",
        int | None,
        min=SMALLEST_SIZE,
    )
    lights: int | str = option("auto", "'auto', or how many.")
    """Lamps, 1 to 4; "auto" decides by evidence, and may find none."""
    brdf: str = option("oren-nayar", "oren-nayar, lambert, minnaert or spherical-harmonics.")
    """One of `lighting.shading.DIFFUSE_MODELS`, or "spherical-harmonics"."""
    unit: str = option("auto", "auto, mm, cm or m.", choices=("auto", "mm", "cm", "m"))
    """Of the scan's file."""
    quality: Quality | str = option(
        "standard", "draft, standard, best (standard with 1024 texels a side), or paper.", metavar="NAME"
    )
    """The options of every stage, or the name of a preset."""
    budget: BudgetLike = option(None, "Seconds a scan may take.", float | None)
    """Seconds for the whole run, or a Budget whose evaluations hold for each stage."""
    seed: int = option(0, "Seed of every random step.", int, min=0)
    """Same seed, input and budget in evaluations: same result, bit by bit."""
    skip: Sequence[str] = option((), "A stage to leave out; may be repeated.", list[str])
    """Names from `STAGES`."""
    force: Sequence[str] = option(
        (),
        "An optional step to carry out in any case, such as albedo.shadows; may be repeated.",
        list[str],
    )
    """Names from `STEPS`: steps to carry out whatever the evidence says, where there is anything to do (a
    saturated texel to inpaint)."""
    pictures: bool = option(True, "Draw overview.png and error_vs_time.png among the files.", bool)
    files: str = option(
        "standard",
        "minimal: without pictures, EXR of the geometry image and light; standard; or all.",
        choices=("minimal", "standard", "all"),
    )
    """Which files are written; "all" also has the unlit scan."""
    textures: str | Path | None = option(
        None,
        "Folder from which textures may be read beside the scan's own.",
        str | None,
        metavar="DIR",
    )
    """See `load_scan`."""
    landmarks: Any = option(
        None,
        "Landmarks placed by hand, any of 68: a CSV, JSON or MeshLab .pp file, or a folder with files "
        "named after the scans; or auto for those that MediaPipe finds (needs the extra named landmarks).",
        str | None,
        metavar="FILE|auto",
    )
    """Soft constraints of registration and fit, see `load_scan`; "auto": of the fit alone, see
    `detected_landmarks`."""
    unlit: str | None = option(
        None,
        "Also write the scan itself without its light: 'face', or 'all' of it with the same lamps.",
        str | None,
        choices=(None, "face", "all"),
        metavar="face|all",
    )
    """With its own vertices, coordinates and texels; see `unlit_scan`."""
    maps: str | None = option(
        None,
        "Also normal, displacement, cavity, occlusion, roughness, specular maps, GLB and OpenUSD: "
        "on the chart, the scan's own texture coordinates, or your template's.",
        str | None,
        choices=(None, "chart", "scan", "template"),
        metavar="chart|scan|template",
    )
    """See `engine_maps`."""
    texture_size: int = option(
        1024,
        "Height and width of those, and of the texture on your own template, up to 8192.",
        int,
        min=SMALLEST_SIZE,
    )
    white_balance: str | Sequence[float] = option(
        "none",
        "none; grey-skin: skin gets people's mean colour; or the linear colour of something grey in it.",
        metavar="none|grey-skin|R,G,B",
    )
    """Of the scan's colours, before its light is sought; the linear colour (R, G, B) is divided out."""
    linear_model: LinearFaceModel | str | Path | None = option(
        None,
        "A linear (morphable) model's file (FLAME, Basel, Surrey, your own) to fit coefficients of.",
        str | None,
        metavar="FILE",
    )
    """The model, or its file; `template` is then its mesh."""

    def __post_init__(self) -> None:
        from scan2albedo.albedo.estimate import check_light_options
        from scan2albedo.pipeline.quality import PRESETS
        from scan2albedo.unlit.template_baking import LARGEST_TEXTURE

        for name, value in self._read().items():
            object.__setattr__(self, name, value)
        checked_seed(self.seed)
        check_light_options(self.lights, self.brdf)
        if isinstance(self.quality, str) and self.quality not in PRESETS:
            raise ValueError(f"quality is {self.quality!r}, expected one of {', '.join(PRESETS)}")
        for chosen in fields(self):
            choices, value = chosen.metadata["choices"], getattr(self, chosen.name)
            if choices and value not in choices:
                raise ValueError(
                    f"{chosen.name} is {value!r}, expected one of {', '.join(map(str, choices))}"
                )
        if self.linear_model is not None and self.model == "none":
            raise ValueError("linear_model needs the model of a face: leave model='none' out")
        sides = {"size": (self.texels, LARGEST_SIZE), "texture_size": (self.texture_size, LARGEST_TEXTURE)}
        for name, (size, most) in sides.items():
            if not isinstance(size, Integral) or not SMALLEST_SIZE <= size <= most:
                raise ValueError(f"{name} is {size!r}, expected an integer from {SMALLEST_SIZE} to {most}")
        self._check_stages()

    def _read(self) -> Values:
        """Return the options as they are kept, whatever a caller wrote for them."""
        read = {**vars(self), "landmarks": landmarks_option(self.landmarks)}
        for name, value in read.items():
            if isinstance(value, Path):
                read[name] = str(value)
            elif name in ("seed", "lights") and isinstance(value, str) and re.fullmatch("-?[0-9]+", value):
                read[name] = int(value)
        if self.files == "all" and self.unlit is None:
            read["unlit"] = "face"
        if self.model is None:
            read["model"] = "default"
        read |= {"budget": Budget.of(self.budget), "skip": tuple(self.skip), "force": tuple(self.force)}
        read["white_balance"] = checked_white_balance(self.white_balance)
        return read

    def _check_stages(self) -> None:
        """Raise ValueError for stages and steps that cannot be skipped or forced."""
        from scan2albedo.pipeline.quality import STAGES, STEPS

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

    @classmethod
    def with_changes(cls, options: Self | None, changes: Mapping[str, Any]) -> Self:
        """Return options, the default ones when None, with some others; TypeError for names of none.

        A misspelt name is refused with the one that was meant.
        """
        names = [option.name for option in fields(cls)]
        for wrong in changes:
            if wrong not in names:
                known = ["name", "on_progress", *names]
                near = difflib.get_close_matches(wrong, known, 1)
                hint = f": did you mean {near[0]!r}?" if near else f"; options are {', '.join(known)}"
                raise TypeError(f"process() has no option {wrong!r}{hint}")
        return replace(cls() if options is None else options, **changes)

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
        from scan2albedo.pipeline.quality import PRESETS

        return PRESETS[self.quality] if isinstance(self.quality, str) else self.quality

    def of_registration(self) -> RegistrationOptions:
        """Return the preset's options of registration with what the caller skips or forces."""
        stage, step = self.stages.registration, "register.depth_annealing"
        if step in self.skip:
            return replace(stage, annealing_evaluations=0)
        return replace(stage, force_annealing=True) if step in self.force else stage

    def of_albedo(self) -> EstimateOptions:
        """Return the preset's options of the albedo with the steps that the caller skips or forces."""
        from scan2albedo.albedo import OPTIONAL_STEPS

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


class ProcessChanges(TypedDict, total=False):
    """The fields of `ProcessOptions` as keyword arguments: what type checkers read of them."""

    model: AnnotatedFaceModel | str | Path | None
    size: int | None
    lights: int | str
    brdf: str
    unit: str
    quality: Quality | str
    budget: BudgetLike
    seed: int
    skip: Sequence[str]
    force: Sequence[str]
    pictures: bool
    files: str
    textures: str | Path | None
    landmarks: Any
    unlit: str | None
    maps: str | None
    texture_size: int
    white_balance: str | Sequence[float]
    linear_model: LinearFaceModel | str | Path | None


def checked_white_balance(asked: str | Sequence[float]) -> str | Sequence[float]:
    """Return one of `BALANCES`, or the colour of grey; numbers may be text, "R,G,B". May raise ValueError.

    >>> checked_white_balance("1, .9,.7")
    (1.0, 0.9, 0.7)
    """
    if isinstance(asked, str) and asked in BALANCES:
        return asked
    try:
        grey = tuple(float(part) for part in (asked.split(",") if isinstance(asked, str) else asked))
    except (TypeError, ValueError):
        grey = ()
    if len(grey) != 3 or not all(0 < channel < math.inf for channel in grey):
        raise ValueError(
            f"white_balance is {asked!r}, expected {', '.join(BALANCES)}, or the linear colour R,G,B, three "
            "numbers above 0, that something grey has in the scan"
        )
    return grey
