"""The flags of `process`, written once for every command that processes scans."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from scan2albedo.pipeline.options import ProcessOptions

SeedOption = Annotated[int, typer.Option(help="Seed of every random step.", min=0)]
SizeOption = Annotated[int, typer.Option(help="Height and width of the geometry image in texels.", min=8)]
PresetSizeOption = Annotated[
    int | None,
    typer.Option(help="Height and width of the geometry image in texels; else 512, 256 in drafts.", min=8),
]
QualityOption = Annotated[str, typer.Option(help="draft, standard or best: what every stage spends.")]


def _options_of_flags(
    model: Annotated[
        str,
        typer.Option(
            help="A model's JSON file; a template's mesh; 'default'; or 'none' for an object without a face."
        ),
    ] = "default",
    size: PresetSizeOption = None,
    lights: Annotated[str, typer.Option(help="'auto', or how many.")] = "auto",
    brdf: Annotated[
        str, typer.Option(help="oren-nayar, lambert, minnaert or spherical-harmonics.")
    ] = "oren-nayar",
    unit: Annotated[str, typer.Option(help="auto, mm, cm or m.")] = "auto",
    quality: QualityOption = "standard",
    budget: Annotated[float | None, typer.Option(help="Seconds a scan may take.")] = None,
    seed: SeedOption = 0,
    skip: Annotated[list[str] | None, typer.Option(help="A stage to leave out; may be repeated.")] = None,
    force: Annotated[
        list[str] | None,
        typer.Option(
            help="An optional step to carry out in any case, such as albedo.shadows; may be repeated."
        ),
    ] = None,
    pictures: Annotated[
        bool, typer.Option(help="Draw overview.png and error_vs_time.png among the files.")
    ] = True,
) -> ProcessOptions:
    """Return what the flags ask for; a new flag of `process` is a parameter here and passed on below."""
    light_choice = _light_choice(lights)
    from scan2albedo.pipeline.options import ProcessOptions

    try:
        return ProcessOptions(
            model=model,
            size=size,
            lights=light_choice,
            brdf=brdf,
            unit=unit,
            quality=quality,
            budget=budget,
            seed=seed,
            skip=tuple(skip or ()),
            force=tuple(force or ()),
            pictures=pictures,
        )
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def with_process_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the flags of `process` in place of its parameter `options`.

    Parameters
    ----------
    command : callable
        With a parameter `options`, which gets checked `ProcessOptions`.
    """
    flags = inspect.signature(_options_of_flags, eval_str=True, locals={"ProcessOptions": object}).parameters
    own = inspect.signature(command, eval_str=True, locals={"ProcessOptions": object}).parameters

    @functools.wraps(command)
    def called(**given: Any) -> None:
        options = _options_of_flags(**{name: given.pop(name) for name in flags})
        command(options=options, **given)

    shown: list[inspect.Parameter] = []
    for name, parameter in own.items():
        shown += flags.values() if name == "options" else [parameter]
    keywords = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in shown]
    called.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in keywords}
    return called


def _light_choice(lights: str) -> str | int:
    if lights == "auto":
        return lights
    try:
        return int(lights)
    except ValueError:
        raise typer.BadParameter(f"--lights takes 'auto' or a whole number, not {lights!r}") from None
