"""Run a bench: every method on every case, timed and scored, as rows with their summaries."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import Scan2AlbedoError

CPU = "CPU s"
"""Column of the CPU seconds of this process with all its threads."""
SUMMARIES: dict[str, Callable[[NDArray[np.float64]], float]] = {
    "n": lambda values: float(len(values)),
    "sum": lambda values: float(values.sum()),
    "least": lambda values: float(values.min()),
    "mean": lambda values: float(values.mean()),
    "median": lambda values: float(np.median(values)),
    "rms": lambda values: float(np.sqrt(np.mean(values**2))),
    "worst": lambda values: float(values.max()),
}
"""What the rows of a method are summarised to; "n" the number of them, "worst" the largest."""
ALL = "all"
"""The group that holds every case."""

Method = Callable[[Any], Any]
"""From a scene to an answer; what a method needs and lacks it reports by ModuleNotFoundError."""
Values = Mapping[str, float | str]
"""Numbers of a row by column, and words that are printed behind them."""


@dataclass(frozen=True)
class Timed:
    """An answer that knows its CPU seconds better than the runner, such as one of another process."""

    answer: Any
    cpu_s: float


@dataclass(frozen=True)
class Case:
    """A scene to be made when it is wanted, and the group with which it is summarised."""

    name: str
    make: Callable[[], Any]
    group: str = ""

    def is_wanted(self, names: Sequence[str]) -> bool:
        """Return whether one of the names is the first words of its name or its group; none means any.

        >>> case = Case("wood 1", dict, group="face clean")
        >>> case.is_wanted(["wood"]), case.is_wanted(["face"]), case.is_wanted(["face cl"])
        (True, True, False)
        """
        own = (f"{self.name} ", f"{self.group} ")
        return not names or any(each.startswith(f"{name} ") for name in names for each in own)


@dataclass(frozen=True)
class Bench:
    """What is compared on what, and how it is judged.

    Parameters
    ----------
    cases : callable
        From "is it quick?" to cases; FileNotFoundError where data are not there.
    methods, peers : mapping of str to callable
        Ours, the first being the one to judge, and others'.
    score : callable
        From a scene and an answer to the numbers and words of a row.
    slow : sequence of str
        Methods that run only where they are asked for by name.
    quick : sequence of str
        The only methods of a quick run; all that are not slow when empty.
    error : str
        Column of the picture of error against run time; the first when empty.
    summaries : sequence of str
        Which of `SUMMARIES` to print.
    warm : bool
        Whether every method runs once on the first case before the clock counts.
    repeats : int
        Runs of each method, in turns; the one of least CPU time counts.
    picture : callable, optional
        From a scene and its answers by method to an image (H, W, 3) for `--pictures`.
    remarks : callable, optional
        From all rows to lines that are printed after the summaries.
    """

    cases: Callable[[bool], Iterable[Case]]
    methods: Mapping[str, Method]
    score: Callable[[Any, Any], Values]
    peers: Mapping[str, Method] = field(default_factory=dict)
    slow: Sequence[str] = ()
    quick: Sequence[str] = ()
    error: str = ""
    summaries: Sequence[str] = ("mean", "worst")
    warm: bool = False
    repeats: int = 1
    picture: Callable[[Any, Mapping[str, Any]], NDArray[Any]] | None = None
    remarks: Callable[[Sequence[Row]], Iterable[str]] | None = None

    def chosen(self, names: Sequence[str], quick: bool) -> dict[str, Method]:
        """Return the methods of a run.

        Raises
        ------
        ValueError
            For a name that no method has.
        """
        known = {**self.methods, **self.peers}
        usual = [name for name in known if name not in self.slow]
        wanted = names or (quick and self.quick) or usual
        if unknown := [name for name in wanted if name not in known]:
            raise ValueError(f"{unknown[0]!r} is none of the methods {', '.join(known)}")
        return {name: known[name] for name in wanted}


@dataclass(frozen=True)
class Row:
    """One method on one case; `failed` where it gave no answer, and `note` then says why."""

    case: str
    group: str
    method: str
    values: Mapping[str, float]
    note: str = ""
    failed: bool = False


def run(
    bench: Bench,
    only: Sequence[str] = (),
    methods: Sequence[str] = (),
    quick: bool = False,
    pictures: Path | None = None,
) -> Iterator[Row]:
    """Yield a row for each case and method as it is done."""
    chosen = bench.chosen(methods, quick)
    warm = bench.warm
    try:
        cases = [case for case in bench.cases(quick) if case.is_wanted(only)]
    except (FileNotFoundError, SystemExit) as error:
        yield Row("-", "", "-", {}, f"no data: {error}", failed=True)
        return
    for case in cases:
        try:
            scene = case.make()
        except (FileNotFoundError, SystemExit, Scan2AlbedoError) as error:
            yield Row(case.name, case.group, "-", {}, str(error), failed=True)
            continue
        if warm:
            _answers(chosen, scene, 1)
            warm = False
        answers = _answers(chosen, scene, bench.repeats)
        for name, (answer, measured) in answers.items():
            if isinstance(answer, Exception):
                yield Row(case.name, case.group, name, measured, str(answer), failed=True)
                continue
            values = {**bench.score(scene, answer)}
            numbers = {key: float(value) for key, value in values.items() if not isinstance(value, str)}
            words = [value for value in values.values() if isinstance(value, str)]
            yield Row(case.name, case.group, name, {**numbers, **measured}, " ".join(words))
        if pictures is not None and bench.picture is not None:
            _write_picture(bench.picture, scene, answers, pictures / f"{case.name.replace(' ', '_')}.png")


def _answers(
    methods: Mapping[str, Method], scene: Any, repeats: int
) -> dict[str, tuple[Any, dict[str, float]]]:
    """Return what each method answers, or raises, and what that cost; methods take turns."""
    found: dict[str, tuple[Any, dict[str, float]]] = {}
    for _ in range(repeats):
        for name, method in methods.items():
            start = time.process_time()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    answer = method(scene)
            except (ModuleNotFoundError, Scan2AlbedoError) as error:
                answer = error
            cost = {CPU: time.process_time() - start}
            if isinstance(answer, Timed):
                cost[CPU] = answer.cpu_s
                answer = answer.answer
            if name not in found or cost[CPU] < found[name][1][CPU]:
                found[name] = answer, cost
    return found


def _write_picture(
    draw: Callable[[Any, Mapping[str, Any]], NDArray[Any]],
    scene: Any,
    answers: Mapping[str, tuple[Any, Any]],
    path: Path,
) -> None:
    from scan2albedo.io.images import write_png

    shown = {name: answer for name, (answer, _) in answers.items() if not isinstance(answer, Exception)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, draw(scene, shown))


Summary = dict[str, dict[str, dict[str, dict[str, float]]]]
"""Group, method, one of `SUMMARIES`, column."""


def summarised(rows: Sequence[Row]) -> Summary:
    """Return the summaries of each group and of all cases; numbers that are not finite do not count."""
    done = [row for row in rows if not row.failed]
    groups = dict.fromkeys(row.group for row in done if row.group)
    summary: Summary = {}
    for group in [*groups, ALL]:
        inside = [row for row in done if group in (row.group, ALL)]
        for method in dict.fromkeys(row.method for row in inside):
            own = [row for row in inside if row.method == method]
            columns: dict[str, NDArray[np.float64]] = {}
            for name in dict.fromkeys(name for row in own for name in row.values):
                values = np.array([row.values.get(name, np.nan) for row in own])
                columns[name] = values[np.isfinite(values)]
            summary.setdefault(group, {})[method] = {
                title: {name: reduce(values) for name, values in columns.items() if len(values)}
                for title, reduce in SUMMARIES.items()
            }
    return summary


@dataclass(frozen=True)
class Bar:
    """The least or the most that a summary of a bench may be."""

    bench: str
    method: str
    summary: str
    column: str
    group: str = ALL
    quick: bool = True
    at_most: float = np.inf
    at_least: float = -np.inf

    def verdict(self, summary: Summary) -> tuple[bool, str]:
        """Return whether it is kept, and a line that says so."""
        name = f"{self.bench}: {self.summary} {self.column} of {self.method}, {self.group} cases"
        value = summary.get(self.group, {}).get(self.method, {}).get(self.summary, {}).get(self.column)
        if value is None:
            return False, f"{name}: not measured"
        kept = self.at_least <= value <= self.at_most
        bound = f"at most {self.at_most:g}" if np.isfinite(self.at_most) else f"at least {self.at_least:g}"
        return kept, f"{name}: {value:.4g}, {bound}{'' if kept else ' BROKEN'}"
