"""What the door lets in: faces in raw stereo, and everything else.

    OMP_NUM_THREADS=1 python tools/bench_door.py [--stereo 1000] [--ict 300] [--hard 400] [--placed 60]
        [--scraps 300] [--reliefs 200] [--objects] [--repeat 20 [--fit]] [--told] [--offset 0] [--jobs 1]
        [--json FILE] [--figure FILE.png]

"stereo" are random people of `worlds.stereo`, "ict" mixtures of light-stage people and expressions
captured in the same way, "hard" both with up to 6 mm of noise, more holes and less of the face (there is
shown what confidence is worth; --placed gives five landmarks to these, then with one 25 mm off), "scraps"
captures of both that show no face, "reliefs" random reliefs and bodies (every tenth also without a known
unit), "objects" 43 things. A pose is right within 10 degrees and
15 mm (mean over 68 landmarks) of the one that lays brows, nose and eyes on the model's. "sure misses" were
accepted with a confidence of 0.5 and more. The bins of confidence hold all scans of the parts that ran; a
refused scan counts when its error has a `confidence` (a refused face as right, or as its error's
`model_from_scan` is).
"repeat" captures twenty shapes ten times each. "told" prints what `process` says of faces that are not as
people's are. Scans are numbered from --offset on; none is one of the first 100,000 seeds. Needs
../shared/data.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
from benchmarks.door_repeat import CAPTURES, SHAPES, Capture, captured, print_repeats
from benchmarks.door_rows import Reliability, Row, judged, plainly, print_part
from benchmarks.door_told import print_told
from worlds.door import Case, hard_person, light_stage_person, own_person, relief, scrap, with_landmarks
from worlds.objects import wrong_object, wrong_objects

from scan2albedo.core import RawScan
from scan2albedo.pipeline.scale_search import registered_at_any_scale
from scan2albedo.registration import Registration

ANY_UNIT = "reliefs, any unit"
PLACED, ONE_WRONG = "hard, five landmarks", "hard, one of five wrong"
_EVERY = 10
"""Of so many reliefs one is also registered without a known unit."""


def _object(number: int) -> Case:
    name, scan = wrong_object(number)
    return Case(scan, (name,))


CASES: dict[str, Callable[[int], Case]] = {
    "stereo": own_person,
    "ict": light_stage_person,
    "hard": hard_person,
    PLACED: lambda number: with_landmarks(hard_person(number), number),
    ONE_WRONG: lambda number: with_landmarks(hard_person(number), number, one_wrong=True),
    "scraps": scrap,
    "reliefs": relief,
    ANY_UNIT: relief,
    "objects": _object,
}


def _at_any_scale(scan: RawScan) -> Registration:
    _, found = registered_at_any_scale(scan, True, lambda scan: (scan, plainly(scan)))
    return found


@cache
def _warm_up() -> None:
    """Load and compile what the first registration of a process needs."""
    plainly(own_person(0).scan)


def row(task: tuple[str, int]) -> Row:
    """Make a scan of a part and judge what becomes of it."""
    part, number = task
    _warm_up()
    return judged(part, number, CASES[part](number), _at_any_scale if part == ANY_UNIT else plainly)


def capture(task: tuple[int, int, bool]) -> Capture:
    """Capture a shape."""
    shape, capture_seed, fitting = task
    _warm_up()
    return captured(shape, capture_seed, fitting=fitting)


def in_processes(function: Callable, tasks: Sequence, jobs: int) -> list:
    """Return the function's values, in `jobs` processes of one thread."""
    if jobs == 1:
        return [function(task) for task in tasks]
    with ProcessPoolExecutor(jobs) as processes:
        return list(processes.map(function, tasks, chunksize=4))


def run(arguments: argparse.Namespace) -> list[Row]:
    """Run the parts asked for, print their tables, and return their rows."""
    rows: list[Row] = []
    counts = {name: getattr(arguments, name) for name in ("stereo", "ict", "hard", "scraps", "reliefs")}
    counts |= {PLACED: arguments.placed, ONE_WRONG: arguments.placed}
    counts[ANY_UNIT] = -(-arguments.reliefs // _EVERY)
    for part, count in counts.items():
        tasks = [(part, arguments.offset + number) for number in range(count)]
        if tasks:
            rows += _part(part, tasks, arguments.jobs)
    if arguments.objects:
        rows += _part(
            "objects", [("objects", number) for number in range(len(wrong_objects()))], arguments.jobs
        )
    return rows


def _part(part: str, tasks: list[tuple[str, int]], jobs: int) -> list[Row]:
    rows: list[Row] = in_processes(row, tasks, jobs)
    print_part(part, rows)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stereo", type=int, default=0, metavar="N", help="random people")
    parser.add_argument("--ict", type=int, default=0, metavar="N", help="light-stage people")
    parser.add_argument("--hard", type=int, default=0, metavar="N", help="people in far worse captures")
    parser.add_argument("--placed", type=int, default=0, metavar="N", help="the same with landmarks given")
    parser.add_argument("--scraps", type=int, default=0, metavar="N", help="scraps that show no face")
    parser.add_argument("--reliefs", type=int, default=0, metavar="N", help="random reliefs and bodies")
    parser.add_argument("--objects", action="store_true", help="43 things that are not faces")
    parser.add_argument("--repeat", type=int, default=0, metavar="N", help=f"shapes, up to {SHAPES}")
    parser.add_argument("--fit", action="store_true", help="also the poses that fits end with, for --repeat")
    parser.add_argument("--told", action="store_true", help="what process says of false faces")
    parser.add_argument("--offset", type=int, default=0, help="number of the first scan")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", type=Path, help="file for all rows")
    parser.add_argument("--figure", type=Path, help="PNG of confidence against the share that is right")
    arguments = parser.parse_args()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)
    rows = run(arguments)
    if any(row.sure is not None for row in rows):
        reliability = Reliability.of(rows)
        reliability.print()
        if arguments.figure:
            reliability.draw(arguments.figure)
    shapes = range(min(arguments.repeat, SHAPES))
    tasks = [(shape, arguments.offset + k, arguments.fit) for shape in shapes for k in range(CAPTURES)]
    captures: list[Capture] = in_processes(capture, tasks, arguments.jobs)
    if captures:
        print_repeats(captures)
    if arguments.told:
        print_told(arguments.offset)
    if arguments.json:
        everything = {"scans": [asdict(row) for row in rows], "captures": [asdict(c) for c in captures]}
        arguments.json.write_text(json.dumps(everything, default=np.ndarray.tolist, indent=1))


if __name__ == "__main__":
    main()
