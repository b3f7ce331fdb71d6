"""Damaged files of every kind that is read: each must end in a result or in one clear error, soon and small.

    python tools/mutate_files.py [--files 3000] [--seed 0] [--jobs 1] [--only NUMBER] [--keep FOLDER]

File NUMBER is the same in every run with the same seed. Each is loaded in a worker process whose peak of
memory is measured for that file alone; a worker that dies, or takes more than ten times the limit on the wall
clock, counts too. Prints how the files ended and every finding; the exit status is 1 when there is one.
"""

import argparse
import multiprocessing
import shutil
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from mutated_files.base_files import BaseFile, base_files
from mutated_files.mutations import MUTATIONS, mutated

from scan2albedo.errors import Scan2AlbedoError

MEMORY_BYTES = 2e9
"""What loading a file may take."""
CPU_S = 20.0
"""How long loading a file may take, in seconds of CPU."""
HARD_MEMORY_BYTES = 6 << 30
"""The memory at which a worker is stopped, so that the machine goes on."""
WALL_S = 10 * CPU_S
"""The time on the wall clock after which a worker is stopped, in seconds."""
LOADED = "loaded"
REFUSED = "refused"


@dataclass(frozen=True)
class Outcome:
    """How one file ended: `LOADED`, `REFUSED`, or what left bare; its costs, and a message."""

    number: int
    kind: str
    mutation: str
    ending: str
    message: str = ""
    cpu_s: float = 0.0
    memory_bytes: float = 0.0

    @property
    def fault(self) -> str:
        """What is wrong about it, "" when nothing is."""
        if self.ending not in (LOADED, REFUSED):
            return f"bare {self.ending}"
        if self.memory_bytes > MEMORY_BYTES:
            return "over 2 GB"
        return "over 20 s" if self.cpu_s > CPU_S else ""

    def line(self) -> str:
        """Return one line for a person."""
        costs = f"{self.cpu_s:.1f} s, {self.memory_bytes / 1e9:.2f} GB"
        return f"{self.number}: {self.fault} ({self.kind}, {self.mutation}, {costs}): {self.message[:300]}"


@dataclass(frozen=True)
class Work:
    """Which files are made."""

    bases: Sequence[BaseFile]
    seed: int

    def make(self, number: int, folder: Path) -> tuple[BaseFile, str]:
        """Write file `number` and what belongs to it into a folder; return whence it comes, and how."""
        rng = np.random.default_rng([self.seed, number])
        base = self.bases[number % len(self.bases)]
        mutation = MUTATIONS[rng.integers(len(MUTATIONS))]
        files = dict(base.files)
        for name in base.damaged:
            files[name] = mutated(name, files[name], mutation, rng)
        for name, data in files.items():
            (folder / name).write_bytes(data)
        return base, mutation.__name__

    def run(self, number: int) -> Outcome:
        """Make a file, load it, and return how that ended."""
        with tempfile.TemporaryDirectory() as place:
            base, mutation = self.make(number, Path(place))
            _forget_peak_memory()
            start = time.process_time()
            ending, message = LOADED, ""
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    base.read(Path(place) / base.first)
            except Scan2AlbedoError as error:
                ending, message = REFUSED, str(error)
            # Whatever else is raised is what this looks for.
            except BaseException as error:  # noqa: BLE001
                ending, message = type(error).__name__, str(error)
            memory = _memory_bytes("VmHWM")
            if "needs more memory than there is" in message:
                memory = max(memory, HARD_MEMORY_BYTES)
            seconds = time.process_time() - start
            return Outcome(number, base.kind, mutation, ending, message, seconds, memory)


def _memory_bytes(field: str) -> float:
    text = Path("/proc/self/status").read_text()
    return 1024.0 * int(text.split(f"{field}:")[1].split()[0])


def _forget_peak_memory() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _worker(work: Work, link: Connection) -> None:
    """Answer numbers with outcomes until the link is closed."""
    import resource

    for base in work.bases:  # compiles and imports what all files need
        with tempfile.TemporaryDirectory() as place:
            for name, data in base.files.items():
                (Path(place) / name).write_bytes(data)
            with suppress(Scan2AlbedoError):  # an older version may lack a format
                base.read(Path(place) / base.first)
    resource.setrlimit(resource.RLIMIT_AS, (int(_memory_bytes("VmSize")) + HARD_MEMORY_BYTES,) * 2)
    link.send(None)
    while True:
        try:
            number = link.recv()
        except EOFError:
            return
        link.send(work.run(number))


class Worker:
    """A process that loads files, replaced when it dies or takes too long."""

    def __init__(self, work: Work) -> None:
        self._work = work
        self._start()

    def _start(self) -> None:
        self._link, theirs = multiprocessing.Pipe()
        self._process = multiprocessing.Process(target=_worker, args=(self._work, theirs), daemon=True)
        self._process.start()
        theirs.close()
        self._link.recv()

    def give(self, number: int) -> None:
        """Begin with a file."""
        self._number, self._since = number, time.monotonic()
        self._link.send(number)

    def take(self, wait_s: float) -> Outcome | None:
        """Return how the file ended, None when it has not yet."""
        try:
            if self._link.poll(wait_s):
                outcome: Outcome = self._link.recv()
                return outcome
            if time.monotonic() - self._since < WALL_S:
                return None
            ending = "timeout"
        except (EOFError, ConnectionError):
            self._process.join()
            ending = f"death of the process ({self._process.exitcode})"
        kind = self._work.bases[self._number % len(self._work.bases)].kind
        self.stop()
        self._start()
        return Outcome(self._number, kind, "?", ending)

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


def outcomes(work: Work, numbers: Sequence[int], jobs: int) -> list[Outcome]:
    """Load files in `jobs` processes; a line for every hundredth of them."""
    left = list(reversed(numbers))
    done = []
    said = 0
    workers = [Worker(work) for _ in range(min(jobs, len(numbers)))]
    busy = dict.fromkeys(workers, False)
    while left or any(busy.values()):
        for worker in workers:
            if not busy[worker] and left:
                worker.give(left.pop())
                busy[worker] = True
            if busy[worker] and (outcome := worker.take(0.05)) is not None:
                busy[worker] = False
                done.append(outcome)
                if outcome.fault:
                    print(outcome.line(), flush=True)
        if len(done) * 20 // len(numbers) > said:
            said = len(done) * 20 // len(numbers)
            print(f"{len(done)} of {len(numbers)} files", flush=True)
    for worker in workers:
        worker.stop()
    return done


def table(rows: Sequence[Outcome]) -> str:
    """Return how the files of each kind ended."""
    lines = [f"{'kind':<28}{'files':>7}{'loaded':>8}{'refused':>8}{'faults':>8}{'most s':>8}{'most GB':>9}"]
    for kind in dict.fromkeys(row.kind for row in sorted(rows, key=lambda row: row.number)):
        of_kind = [row for row in rows if row.kind == kind]
        ended = Counter(row.ending for row in of_kind)
        faults = sum(bool(row.fault) for row in of_kind)
        seconds, memory = max(r.cpu_s for r in of_kind), max(r.memory_bytes for r in of_kind) / 1e9
        lines.append(
            f"{kind:<28}{len(of_kind):>7}{ended[LOADED]:>8}{ended[REFUSED]:>8}{faults:>8}"
            f"{seconds:>8.1f}{memory:>9.2f}"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", type=int, help="load this one file, in this process")
    parser.add_argument("--keep", type=Path, help="folder for the file of --only")
    options = parser.parse_args()
    work = Work(tuple(base_files()), options.seed)
    if options.only is not None:
        if options.keep is not None:
            shutil.rmtree(options.keep, ignore_errors=True)
            options.keep.mkdir(parents=True)
            work.make(options.only, options.keep)
        outcome = work.run(options.only)
        print(outcome.fault or outcome.ending, outcome.line())
        return int(bool(outcome.fault))
    rows = outcomes(work, range(options.files), options.jobs)
    print(table(rows))
    faults = Counter(row.fault for row in rows if row.fault)
    bare = sum(count for fault, count in faults.items() if fault.startswith("bare"))
    print(
        f"{len(rows)} files: {bare} bare errors, {faults['over 2 GB']} over 2 GB, "
        f"{faults['over 20 s']} over 20 s"
    )
    return int(bool(faults))


if __name__ == "__main__":
    raise SystemExit(main())
