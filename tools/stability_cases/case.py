"""What a named extreme is, and how one is run: never NaN, never a crash, never a hang."""

from __future__ import annotations

import linecache
import re
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

import scan2albedo
from scan2albedo.core import Plan
from scan2albedo.errors import Scan2AlbedoError

_PACKAGE = Path(scan2albedo.__file__).parent

Ending = Literal["right answer", "measured warning", "named error"]


@dataclass(frozen=True)
class Outcome:
    """How an extreme ended, and the figure (or the message) that shows it."""

    ending: Ending
    figure: str


@dataclass(frozen=True)
class Case:
    """One extreme of one stage.

    Parameters
    ----------
    stage : str
        Such as "fit" or "albedo".
    name : str
        The extreme, such as "stiffness 1e8".
    expected : str
        How it must end.
    check : callable
        Runs the stage, asserts that what comes out is right, and returns the figure that shows it.
        A `Scan2AlbedoError`, or a `ValueError` that the package raises on purpose, that it lets through is a
        named error; a user warning, or a `Measured` figure, is a measured warning.
    slow : bool
        Takes more than some seconds.
    """

    stage: str
    name: str
    expected: Ending
    check: Callable[[], str]
    slow: bool = False

    def __str__(self) -> str:
        return f"{self.stage}: {self.name}"


class Measured(str):
    """A figure of a result that says itself, in a note or a number, that it is in trouble."""

    __slots__ = ()


def said(figure: str, plan: Plan) -> str:
    """Return the figure; with a doubt of the plan it is one of a result that says that it is in trouble."""
    doubts = plan.doubts()
    return Measured(f"{figure}; {doubts[0].text}") if len(doubts) else figure


class Cases(list[Case]):
    """The cases of one module; `extreme` adds one."""

    def extreme(
        self, stage: str, name: str, expected: Ending = "right answer", *, slow: bool = False
    ) -> Callable[[Callable[[], str]], Callable[[], str]]:
        """Add the decorated function as a case."""

        def add(check: Callable[[], str]) -> Callable[[], str]:
            self.append(Case(stage, name, expected, check, slow))
            return check

        return add


def run(case: Case) -> Outcome:
    """Run an extreme; anything but a right answer, a warning or a named error passes as the bug it is."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            figure = case.check()
        except (Scan2AlbedoError, ValueError) as error:
            if not isinstance(error, Scan2AlbedoError) and not raised_on_purpose(error):
                raise
            return Outcome("named error", " ".join(str(error).split()))
    messages = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    strange = [w for w in caught if not issubclass(w.category, UserWarning | DeprecationWarning)]
    assert not strange, f"{case}: {strange[0].category.__name__}: {strange[0].message}"
    if messages or isinstance(figure, Measured):
        return Outcome("measured warning", "; ".join([str(figure), *messages[:1]]))
    return Outcome("right answer", figure)


def assert_ends_as_it_must(case: Case) -> None:
    """Assert that an extreme ends in what is expected of it, and shows how by a figure or a message."""
    outcome = run(case)
    assert outcome.ending == case.expected, outcome.figure
    assert outcome.figure, "a figure or a message must show what happened"


@contextmanager
def naming(*patterns: str) -> Iterator[None]:
    """See that the error that leaves the block says all of this (regular expressions)."""
    try:
        yield
    except (Scan2AlbedoError, ValueError) as error:
        for pattern in patterns:
            if not re.search(pattern, str(error)):
                raise AssertionError(f"{pattern!r} is not in: {error}") from error
        raise


def raised_on_purpose(error: BaseException) -> bool:
    """Return whether a `raise` of the package made the error: NumPy's complaints name no cause."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    here = Path(last.filename).is_relative_to(_PACKAGE)
    return here and linecache.getline(last.filename, last.lineno or 0).lstrip().startswith("raise")


def assert_finite(*arrays: ArrayLike) -> None:
    """Assert that no array holds NaN or infinity."""
    for index, array in enumerate(arrays):
        bad = ~np.isfinite(np.asarray(array, dtype=np.float64))
        assert not bad.any(), f"{bad.sum()} of {bad.size} values of array {index} are not finite"
