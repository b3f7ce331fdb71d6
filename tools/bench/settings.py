"""Settings of a stage as the methods of a bench: presets, one option varied, budgets of evaluations."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

from scan2albedo.core import Budget
from scan2albedo.pipeline.quality import PRESETS

STANDARD = "standard"
FIELDS = {"register": "registration", "fit": "fit", "albedo": "albedo"}
"""Fields of a quality by stage."""


def presets(stage: str) -> dict[str, Any]:
    """Return the options of the presets that do not leave a stage at its default.

    >>> list(presets("fit"))
    ['preset draft']
    """
    every = {name: getattr(quality, FIELDS[stage]) for name, quality in PRESETS.items()}
    return {f"preset {name}": options for name, options in every.items() if options != every[STANDARD]}


def varied(knob: str, options: Any, values: Iterable[Any]) -> dict[str, Any]:
    """Return options for each value of one field of a dataclass.

    >>> from scan2albedo.fitting import FitOptions
    >>> list(varied("steps", FitOptions(), (5, 20)))
    ['steps 5', 'steps 20']
    """
    return {f"{knob} {_plainly(value)}": replace(options, **{knob: value}) for value in values}


def within(
    method: Callable[..., Any], options: Any, evaluations: Iterable[int]
) -> dict[str, Callable[[Any], Any]]:
    """Return a method that ends after so many evaluations, for each number of them."""
    return {
        f"evaluations {count}": partial(method, options=options, budget=Budget(evaluations=count))
        for count in evaluations
    }


def _plainly(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else f"{value:g}"
