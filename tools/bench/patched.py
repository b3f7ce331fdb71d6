"""Constants of a stage as settings of a bench: a method that runs with other values of them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch


def with_constants(module: str, method: Callable[[Any], Any], **values: Any) -> Callable[[Any], Any]:
    """Return a method during which constants of modules have other values.

    Parameters
    ----------
    module : str
        Where the constants stand, under `scan2albedo.reflectance`; several with spaces between: each constant
        is set in the first of them that has it.
    method : callable
    **values
        By the constants' names.
    """
    from importlib import import_module

    def call(scene: Any) -> Any:
        modules = [import_module(f"scan2albedo.reflectance.{name}") for name in module.split()]
        with ExitStack() as stack:
            for name, value in values.items():
                owner = next(one for one in modules if hasattr(one, name))
                stack.enter_context(patch.object(owner, name, value))
            return method(scene)

    return call
