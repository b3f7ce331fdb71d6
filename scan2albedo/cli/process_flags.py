"""The flags of the commands that process scans, made of the fields of `ProcessOptions`."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import Field
from typing import Annotated, Any

import typer

from scan2albedo.pipeline.options import ProcessOptions, option_of_text, process_options

Command = Callable[..., None]


def with_process_flags(*names: str) -> Callable[[Command], Command]:
    """Return a decorator that gives a command flags in place of its parameter `options`.

    Parameters
    ----------
    *names : str
        Fields of `ProcessOptions` that are flags; all when none is given.

    Returns
    -------
    callable
        Decorates a command with a parameter `options`, which gets checked `ProcessOptions`.
    """
    flags = {option.name: _flag(option) for option in process_options() if not names or option.name in names}

    def decorated(command: Command) -> Command:
        @functools.wraps(command)
        def called(**given: Any) -> None:
            chosen = {name: given.pop(name) for name in flags}
            try:
                options = ProcessOptions(**{name: _value(name, value) for name, value in chosen.items()})
            except ValueError as error:
                raise typer.BadParameter(str(error)) from None
            command(options=options, **given)

        shown: list[inspect.Parameter] = []
        for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
            shown += flags.values() if name == "options" else [parameter]
        keywords = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in shown]
        called.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
        called.__annotations__ = {parameter.name: parameter.annotation for parameter in keywords}
        return called

    return decorated


def _flag(option: Field[Any]) -> inspect.Parameter:
    shown = dict(option.metadata)
    kind = shown.pop("flag")
    return inspect.Parameter(
        option.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None if option.default == () else option.default,
        annotation=Annotated[kind, typer.Option(**shown)],
    )


def _value(name: str, given: Any) -> Any:
    """Return an option as `ProcessOptions` takes it: typer gives None for a list without entries."""
    if name in ("skip", "force"):
        return tuple(given or ())
    return option_of_text(name, given) if isinstance(given, str) else given
