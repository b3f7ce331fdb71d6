"""The experiment: scan and process a population, and see who is recognised by what."""

from __future__ import annotations

import os
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from pathlib import Path

from recognition_experiment.methods import albedo_method, joined, method_names, session_templates
from recognition_experiment.options import RecognitionExperimentOptions
from recognition_experiment.report import MethodResult, RecognitionReport
from recognition_experiment.sessions import Session, cached_session, session_of
from scan2albedo.core import Budget, Meter, ProgressCallback
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import Identification, Templates, cmc_curve, identify, roc_curve

STAGE = "experiment.recognition"
_Key = tuple[int, int]


def run_recognition_experiment(
    cache: str | Path | None = None,
    *,
    options: RecognitionExperimentOptions = RecognitionExperimentOptions(),
    budget: Budget | float | None = None,
    jobs: int = 1,
    on_progress: ProgressCallback | None = None,
) -> RecognitionReport:
    """Scan a synthetic population, process every scan, and identify persons by texture and by albedo.

    Each person is scanned once for the gallery and a few times as a probe, under other light and with
    another expression each time; every scan goes through the whole pipeline. What is found is compared by
    the texture as scanned, by filters of it, and by the albedo of each reflectance.

    Parameters
    ----------
    cache : path, optional
        Folder that keeps processed scans: a run that was stopped goes on there, and one of more persons
        begins with them. A folder that is gone afterwards when omitted.
    options : RecognitionExperimentOptions
    budget : Budget or float, optional
        Seconds, or scans to process. When it ends, the persons that are complete by then are reported.
    jobs : int
        Processes to work in.
    on_progress : callable, optional
        Called with every `TraceRow`: rank-1 errors by the first albedo among the persons done so far.

    Returns
    -------
    RecognitionReport

    Raises
    ------
    ValueError
        When `jobs` is below 1.
    RecognitionError
        When the budget ends, or scans fail, before there are two persons; when a process was killed.
    OutputError
        When the cache cannot be written.

    References
    ----------
    Toderici, Passalis, Theoharis, Kakadiaris, "An automated method for human face modeling and relighting
    with application to face recognition", section 5 and figure 10.
    """
    if jobs < 1:
        raise ValueError(f"jobs is {jobs}, expected at least 1")
    meter = Meter(STAGE, "1 - rank-1 rate", Budget.of(budget), on_progress)
    run = _Run(options, meter)
    with _folder(cache) as folder:
        for key in run.wanted():
            if (kept := cached_session(folder, options, *key)) is not None:
                run.take(key, kept)
        missing = [key for key in run.wanted() if key not in run.done]
        for key, session in _made(folder, options, missing, jobs, lambda: meter.exhausted):
            run.take(key, session)
            run.record(key)
    return run.report()


@dataclass
class _Run:
    """Templates of the scans so far by each method, and the messages of those that failed."""

    options: RecognitionExperimentOptions
    meter: Meter
    templates: dict[_Key, dict[str, Templates]] = field(default_factory=dict)
    failures: dict[_Key, str] = field(default_factory=dict)

    @property
    def done(self) -> set[_Key]:
        return {*self.templates, *self.failures}

    def wanted(self) -> list[_Key]:
        scans = range(1 + self.options.probes)
        return [(person, scan) for person in range(self.options.persons) for scan in scans]

    def take(self, key: _Key, session: Session) -> None:
        if session.failure:
            self.failures[key] = session.failure
        else:
            self.templates[key] = session_templates(session, f"{key[0]:04d}", self.options)

    def record(self, key: _Key) -> None:
        """Count a scan that was made; one that completes a person makes a row of the trace."""
        self.meter.count()
        persons = self.persons()
        if key[0] in persons and len(persons) >= 2:
            self.meter.record(1 - self.identification(albedo_method(self.options.brdfs[0]), persons).rate())

    def persons(self) -> list[int]:
        """Persons of whom all scans are done, the gallery's and a probe without failure."""
        scans, done = range(1 + self.options.probes), self.done
        complete = [p for p in range(self.options.persons) if all((p, scan) in done for scan in scans)]
        good = self.templates
        return [p for p in complete if (p, 0) in good and any((p, scan) in good for scan in scans[1:])]

    def identification(self, method: str, persons: list[int]) -> Identification:
        gallery = [self.templates[person, 0][method] for person in persons]
        probes = [
            self.templates[person, scan][method]
            for person in persons
            for scan in range(1, 1 + self.options.probes)
            if (person, scan) in self.templates
        ]
        return identify(joined(gallery), joined(probes), window=self.options.window)

    def report(self) -> RecognitionReport:
        persons, failures = self.persons(), tuple(self.failures.values())
        if len(persons) < 2:
            why = f"; {len(failures)} scans failed, the first with: {failures[0]}" if failures else ""
            raise RecognitionError(
                f"{len(persons)} of {self.options.persons} persons are complete, so nobody can be mistaken; "
                f"give a longer budget (scans that are done are kept in the cache){why}"
            )
        results = []
        for method in method_names(self.options):
            found = self.identification(method, persons)
            results.append(MethodResult(method, found, cmc_curve(found), roc_curve(found)))
        return RecognitionReport(
            self.options,
            tuple(results),
            tuple(persons),
            failures,
            len(self.done) == len(self.wanted()),
            self.meter.trace,
        )


@contextmanager
def _folder(cache: str | Path | None) -> Iterator[Path]:
    if cache is not None:
        yield Path(cache)
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def _made(
    cache: Path,
    options: RecognitionExperimentOptions,
    keys: list[_Key],
    jobs: int,
    ended: Callable[[], bool],
) -> Iterator[tuple[_Key, Session]]:
    """Yield sessions as they are done; when it has `ended`, no other is begun."""
    if jobs == 1:
        for key in keys:
            if ended():
                return
            yield key, session_of(cache, options, *key)
        return
    try:
        yield from _made_in_processes(cache, options, keys, jobs, ended)
    except BrokenProcessPool as error:
        raise RecognitionError(
            "a process that worked on a scan was ended from outside, for want of memory perhaps; run it "
            "again with fewer jobs: scans that are done are kept in the cache"
        ) from error


def _made_in_processes(
    cache: Path,
    options: RecognitionExperimentOptions,
    keys: list[_Key],
    jobs: int,
    ended: Callable[[], bool],
) -> Iterator[tuple[_Key, Session]]:
    waiting = list(reversed(keys))
    with ProcessPoolExecutor(jobs, get_context("spawn"), _begin_worker) as pool:
        running: dict[Future[Session], _Key] = {}
        while True:
            while waiting and len(running) < jobs and not ended():
                key = waiting.pop()
                running[pool.submit(session_of, cache, options, *key)] = key
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), future.result()


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent, and end when it has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
