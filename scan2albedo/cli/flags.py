"""Flags of the command line, made from the fields of `ProcessOptions`."""

from dataclasses import fields, make_dataclass
from functools import cache
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand
from typer.main import get_command

from scan2albedo.core.arrays import Texts
from scan2albedo.pipeline.options import ProcessOptions


@cache
def flags() -> dict[str, Any]:
    """Return the command line's parameter of each option, by its name."""
    rows = [
        (
            option.name,
            option.metadata["flag"],
            typer.Option(option.default, help=option.metadata["help"], **option.metadata["shown"]),
        )
        for option in fields(ProcessOptions)
    ]
    app = typer.Typer(add_completion=False)
    app.command()(make_dataclass("Flags", rows))  # a class with a signature that Typer reads
    return {flag.name: flag for flag in get_command(app).params}


class OptionsCommand(TyperCommand):
    """A command with a parameter `options`, a `ProcessOptions`: in its place there are flags."""

    names: ClassVar[Texts] = tuple(option.name for option in fields(ProcessOptions))
    """Of the options that have one."""

    def __init__(self, *, params: list[Any], **rest: Any) -> None:
        place = [param.name for param in params].index("options")
        own = [flags()[name] for name in self.names]
        super().__init__(params=[*params[:place], *own, *params[place + 1 :]], **rest)

    def invoke(self, ctx: Any) -> Any:
        """Run the command with the options that the flags give."""
        values = {name: ctx.params.pop(name) for name in self.names}
        try:
            ctx.params["options"] = ProcessOptions(**values)
        except ValueError as error:
            raise typer.BadParameter(str(error), ctx=ctx) from None
        return super().invoke(ctx)


class DemoCommand(OptionsCommand):
    """An `OptionsCommand` with few of the flags."""

    names = ("size", "quality", "seed")
