"""Knobs of a stage, turned one at a time, on scenes whose truth is known."""

from __future__ import annotations

import importlib.util
import subprocess
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from scan2albedo.core import Budget
from scan2albedo.errors import Scan2AlbedoError

OURS = "scan2albedo"
T = TypeVar("T")


@dataclass(frozen=True)
class Cost:
    """`cpu_s` of this process with all its threads, and `wall_s`."""

    cpu_s: float
    wall_s: float


def timed(work: Callable[[], T]) -> tuple[T, Cost]:
    """Return what `work` returns, and what it cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, Cost(time.process_time() - cpu, time.perf_counter() - wall)


@dataclass(frozen=True)
class Setting:
    """One way to run a stage: a knob, its value as shown, and what the stage is called with."""

    knob: str
    value: str
    options: Any = None
    budget: Budget | None = None

    @property
    def name(self) -> str:
        """The knob and its value."""
        return f"{self.knob} {self.value}".rstrip()


@dataclass(frozen=True)
class Outcome:
    """One run on one scene: its cost, an error for each of the stage's kinds, and what else to show."""

    cost: Cost
    errors: tuple[float, ...]
    evaluations: int = 0
    details: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ErrorKind:
    """What a stage's error is, and its unit."""

    name: str
    unit: str


@dataclass(frozen=True)
class Peer:
    """Another method for the same scenes.

    Parameters
    ----------
    name : str
    run : callable
        From a scene to an `Outcome`.
    missing : str
        What installs it, empty when it is there.
    """

    name: str
    run: Callable[[Any], Outcome]
    missing: str = ""


@dataclass(frozen=True)
class StageBenchmark:
    """A stage with its scenes and knobs.

    Parameters
    ----------
    name : str
        As the command line calls it.
    errors : tuple of ErrorKind
        The first decides; each gets a panel and a front.
    scenes : callable
        From "is it quick?" to a list of scenes of any kind.
    settings : callable
        From the same to settings; the default comes first.
    run : callable
        From a scene and a setting to an `Outcome`.
    peers : callable
        From "is it quick?" to the peers.
    """

    name: str
    errors: tuple[ErrorKind, ...]
    scenes: Callable[[bool], list[Any]]
    settings: Callable[[bool], list[Setting]]
    run: Callable[[Any, Setting], Outcome]
    peers: Callable[[bool], list[Peer]]


@dataclass(frozen=True)
class Point:
    """One setting or peer: means over the scenes; `worst` error of each kind; NaN errors where it failed."""

    method: str
    knob: str
    value: str
    errors: tuple[float, ...]
    worst: tuple[float, ...]
    cpu_s: float
    wall_s: float
    evaluations: float
    details: Mapping[str, float]

    @property
    def is_ours(self) -> bool:
        """Whether it is a setting of this library."""
        return self.method == OURS

    def line(self) -> str:
        """Return error and time as a line of progress."""
        return f"{self.name}: {self.errors[0]:.4g}, {self.cpu_s:.3f} s CPU"

    @property
    def name(self) -> str:
        """The setting, or the peer's name."""
        return f"{self.knob} {self.value}".rstrip() if self.is_ours else self.method


def measured(
    benchmark: StageBenchmark,
    *,
    quick: bool = False,
    repeats: int = 1,
    on_point: Callable[[Point], None] = lambda point: None,
    more_peers: Sequence[Peer] = (),
) -> list[Point]:
    """Run every setting and every peer that is installed on every scene.

    The default runs once on every scene, and each setting and peer once on the first, before the clock
    counts: so compilers and caches have done their part.

    Parameters
    ----------
    benchmark : StageBenchmark
    quick : bool
        Fewer and smaller scenes, fewer settings.
    repeats : int
        Runs of each; the one of least CPU time counts.
    on_point : callable
        Called with every point as it is done.
    more_peers : sequence of Peer
        Beside the stage's own.
    """
    scenes, points = benchmark.scenes(quick), []
    for scene in scenes[1:]:
        benchmark.run(scene, benchmark.settings(quick)[0])
    for setting in benchmark.settings(quick):
        outcomes = _outcomes(
            partial(_run_setting, benchmark, setting), scenes, repeats, benchmark, setting.name
        )
        points.append(_mean(OURS, setting.knob, setting.value, outcomes))
        on_point(points[-1])
    for peer in (*benchmark.peers(quick), *more_peers):
        if not peer.missing:
            outcomes = _outcomes(peer.run, scenes, repeats, benchmark, peer.name)
            points.append(_mean(peer.name, "peer", peer.name, outcomes))
            on_point(points[-1])
    return points


def _run_setting(benchmark: StageBenchmark, setting: Setting, scene: Any) -> Outcome:
    return benchmark.run(scene, setting)


def _outcomes(
    run: Callable[[Any], Outcome], scenes: list[Any], repeats: int, benchmark: StageBenchmark, name: str
) -> list[Outcome]:
    """Return the outcomes on all scenes; NaN where it fails on one: the others' minutes must not be lost."""
    try:
        run(scenes[0])
        return [min((run(scene) for _ in range(repeats)), key=lambda o: o.cost.cpu_s) for scene in scenes]
    except (Scan2AlbedoError, ImportError, OSError, RuntimeError, subprocess.SubprocessError) as error:
        warnings.warn(f"{name} failed and is left out: {error}", RuntimeWarning, stacklevel=2)
        nothing = float("nan")
        return [Outcome(Cost(nothing, nothing), (nothing,) * len(benchmark.errors))]


def _mean(method: str, knob: str, value: str, outcomes: list[Outcome]) -> Point:
    table = np.array([o.errors for o in outcomes])
    names = dict.fromkeys(name for o in outcomes for name in o.details)

    def mean(values: Iterable[float]) -> float:
        return float(np.mean(list(values)))

    return Point(
        method=method,
        knob=knob,
        value=value,
        errors=tuple(table.mean(0).tolist()),
        worst=tuple(table.max(0).tolist()),
        cpu_s=mean(o.cost.cpu_s for o in outcomes),
        wall_s=mean(o.cost.wall_s for o in outcomes),
        evaluations=mean(o.evaluations for o in outcomes),
        details={name: mean(o.details.get(name, np.nan) for o in outcomes) for name in names},
    )


def varied(knob: str, options: Any, values: Iterable[Any], text: Callable[[Any], str] = str) -> list[Setting]:
    """Return a setting for each value of one field of a dataclass of options.

    >>> from scan2albedo.fitting import FitOptions
    >>> [s.name for s in varied("steps", FitOptions(), (5, 20))]
    ['steps 5', 'steps 20']
    """
    return [Setting(knob, text(value), replace(options, **{knob: value})) for value in values]


def within(options: Any, evaluations: Iterable[int]) -> list[Setting]:
    """Return settings that stop after so many evaluations."""
    return [Setting("evaluations", str(n), options, Budget(evaluations=n)) for n in evaluations]


def missing_modules(*names: str) -> str:
    """Return the command that installs what cannot be found of some modules, empty when all can.

    >>> missing_modules("numpy"), missing_modules("numpy", "no_such_thing")
    ('', 'pip install no_such_thing')
    """
    absent = [name for name in names if importlib.util.find_spec(name) is None]
    return f"pip install {' '.join(absent)}" if absent else ""
