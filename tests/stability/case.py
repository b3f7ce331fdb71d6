"""What a row of the table of extremes is, and how one is run: never NaN, never a crash, never a hang."""

import linecache
import re
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

import scan2albedo
from scan2albedo import Budget
from scan2albedo.errors import Scan2AlbedoError

RIGHT = "right answer"
WARNS = "measured warning"
REFUSES = "named error"
MAY_BE_NAN = {"residual_mm", "distance_mm", "landmark_error_px", "condition", "misfit", "radiance_linear"}
"""Fields that hold NaN where nothing was measured or seen, or infinity: a distant lamp's distance."""

BUDGETS = {"0.001 s": Budget(seconds=1e-3), "1 evaluation": Budget(evaluations=1)}


@dataclass(frozen=True)
class Case:
    """One extreme of one stage.

    Parameters
    ----------
    stage : str
        Such as "fit" or "albedo".
    name : str
        The extreme, such as "stiffness 1e8".
    call : callable
        Calls the stage without arguments and returns what it found. All numbers of it must be finite.
    ends_in : str
        How it must end. A user warning, or a `Measured` figure, is a measured warning; a `Scan2AlbedoError`,
        or a `ValueError` that the package raises on purpose, is a named error.
    figure : callable or str
        Asserts the bound of what was found, and returns the figure that shows it. For a named error: a
        regular expression that its message must match.
    slow : bool
        Takes more than some seconds.
    """

    stage: str
    name: str
    call: Callable
    ends_in: str
    figure: Callable | str
    slow: bool = False

    def __str__(self):
        return f"{self.stage}: {self.name}"


def table(stage, *groups):
    """Return the cases of a stage: groups of rows."""
    return [Case(stage, *row) for row in chain(*groups)]


def rows(ends_in, figure, named, call=None, values=None, slow=False):
    """Return the rows of calls by name that all end alike, or of one call, perhaps for `each` value."""
    calls = each(named, values, call) if values else {named: call} if call else named
    return [(name, call, ends_in, figure, slow) for name, call in calls.items()]


right, warns, refuses = (partial(rows, ending) for ending in (RIGHT, WARNS, REFUSES))


def each(name, values, call):
    """Return calls by name, one for each value: numbers as text, or values by name."""
    named = values if isinstance(values, dict) else {value: float(value) for value in values}
    return {name.format(key): partial(call, value) for key, value in named.items()}


def gap(one, other):
    """Return the largest difference of arrays."""
    return float(np.abs(one - other).max())


class Measured(str):
    """A figure of a result that says itself, in a note or a number, that it is in trouble."""

    __slots__ = ()


def below(bound, text):
    """Return a figure: the text with the values found in it, the first of which must be below a bound."""

    def figure(found):
        values = found if isinstance(found, tuple) else (found,)
        told = text.format(*values)
        assert values[0] < bound, told
        return told

    return figure


def measured(text):
    """Return a figure of a result in trouble: the text with the values that say so."""
    return lambda found: Measured(text.format(*found if isinstance(found, tuple) else (found,)))


def noted(words):
    """Return a figure: the one note of a result that says this."""

    def figure(found):
        (note,) = (note for note in found.notes if words in note)
        return Measured(note)

    return figure


def unfinished(found):
    """Return what has not converged."""
    assert not found.converged
    return found


def said(figure, plan):
    """Return the figure; with a doubt of the plan it is one of a result that says that it is in trouble."""
    doubts = plan.doubts()
    return Measured(f"{figure}; {doubts[0].text}") if len(doubts) else figure


@dataclass(frozen=True)
class Outcome:
    """How an extreme ended, and the figure (or the message) that shows it."""

    ending: str
    figure: str


def run(case):
    """Run an extreme; anything but a right answer, a warning or a named error passes as the bug it is."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            found = case.call()
        except (Scan2AlbedoError, ValueError) as error:
            if not isinstance(error, Scan2AlbedoError) and not raised_on_purpose(error):
                raise
            told = " ".join(str(error).split())
            if case.ends_in == REFUSES:
                assert re.search(case.figure, told), f"{case.figure!r} is not in: {told}"
            return Outcome(REFUSES, told)
    assert_finite(found)
    figure = "no error" if case.ends_in == REFUSES else case.figure(found)
    assert figure, "a figure must show what happened"
    messages = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    strange = [w for w in caught if not issubclass(w.category, UserWarning | DeprecationWarning)]
    assert not strange, f"{case}: {strange[0].category.__name__}: {strange[0].message}"
    if messages or isinstance(figure, Measured):
        return Outcome(WARNS, "; ".join([str(figure), *messages[:1]]))
    return Outcome(RIGHT, figure)


def raised_on_purpose(error):
    """Return whether a `raise` of the package made the error: NumPy's complaints name no cause."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    here = Path(last.filename).is_relative_to(Path(scan2albedo.__file__).parent)
    return here and linecache.getline(last.filename, last.lineno or 0).lstrip().startswith("raise")


def assert_finite(found, name="result"):
    """Assert that no number or array of what was found is NaN or infinite."""
    if isinstance(found, list | tuple):
        for part in found:
            assert_finite(part, name)
    elif isinstance(found, dict):
        assert_finite(list(found.values()), name)
    elif is_dataclass(found):
        for field in fields(found):
            if field.name not in MAY_BE_NAN:
                assert_finite(getattr(found, field.name), field.name)
    elif isinstance(found, float | np.ndarray) and np.asarray(found).dtype.kind == "f":
        bad = ~np.isfinite(found)
        assert not bad.any(), f"{np.sum(bad)} of {np.size(found)} values of {name} are not finite"
