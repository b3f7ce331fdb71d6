"""What a caller may choose, checked before any work: stage names, sizes, lights, reflectance, unit."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

from scan2albedo.albedo.estimate import BRDFS
from scan2albedo.geometry_image.size import LARGEST_SIZE, SMALLEST_SIZE
from scan2albedo.io.units import MM_PER_UNIT

FORCEABLE = (
    "register.depth_annealing",
    "albedo.shadows",
    "albedo.specular",
    "albedo.near_light",
    "albedo.roughness",
    "albedo.rectification",
    "albedo.inpainting",
)
"""Steps that the evidence may leave out: the names that `force` takes."""

STAGES = ("register", "fit", "geometry_image", "albedo", *FORCEABLE)
"""Names of stages and of the steps inside them."""

_NEEDED = {"fit", "geometry_image"}


def check_stage_names(skip: Sequence[str], force: Sequence[str]) -> None:
    """Refuse names that are no stage, and wishes that cannot be met.

    Raises
    ------
    ValueError
        Naming the stage and what may be skipped or forced instead.
    """
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


def check_choices(size: int, lights: int | str, brdf: str, unit: str) -> None:
    """Refuse what a late stage would refuse, before an early one has worked for nothing.

    Raises
    ------
    ValueError
        Naming the choice, what was got and what was expected.
    """
    if not isinstance(size, Integral) or not SMALLEST_SIZE <= size <= LARGEST_SIZE:
        raise ValueError(f"size is {size}, expected at least {SMALLEST_SIZE}, at most {LARGEST_SIZE}")
    if lights != "auto" and (not isinstance(lights, Integral) or not 1 <= lights <= 4):
        raise ValueError(f"lights is {lights!r}, expected 'auto' or a whole number from 1 to 4")
    if brdf not in BRDFS:
        raise ValueError(f"brdf is {brdf!r}, expected one of {', '.join(BRDFS)}")
    if unit != "auto" and unit not in MM_PER_UNIT:
        raise ValueError(f"unit is {unit!r}, expected one of auto, {', '.join(MM_PER_UNIT)}")
