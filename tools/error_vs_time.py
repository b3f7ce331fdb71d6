"""Sweep the quality options of the stages: error against CPU time, beside other methods.

    OMP_NUM_THREADS=1 python tools/error_vs_time.py [STAGE ...] [-o OUT] [--quick] [--repeats 1]
        [--peers-python PYTHON] [--no-slow] [--no-budgets] [--json]

Prints, for each stage, a table of settings with the Pareto front, its knee and the default, and whether
budgets in seconds are kept; writes the same with a figure. Peers that are not installed are named.
`--no-slow` leaves out the slow peers: SciPy's annealing and Mitsuba's gradients for the albedo, and Adam for
glasses; without them a run takes some 15 minutes of CPU. `--peers-python` names a Python that has trimesh's
`nricp_*` with rtree (`pip install trimesh rtree` in an environment of its own).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.albedo import albedo_errors
from benchmarks.fitting import mesh_peers
from benchmarks.glasses import WornGlasses, rms_mm
from benchmarks.run import STAGES, run_benchmarks, write_benchmarks
from benchmarks.sweep import Outcome, Peer, missing_modules, timed

from scan2albedo.io.atomic import check_writable, removed_if_empty
from scan2albedo.io.records import plain_json
from scan2albedo.synthetic import SyntheticScene

ADAM_ITERATIONS = (30, 300, 1500)
ADAM_STEP_MM = 0.3
MITSUBA = "Mitsuba gradients"
MITSUBA_TRIAL = """
from benchmarks.albedo_peers_slow import DescentOptions, mitsuba_inverse
from scan2albedo.synthetic import face
mitsuba_inverse(face(size=24).image, 1, DescentOptions(trial_steps=1, steps=1))
"""


def albedo_peers() -> list[Peer]:
    """Return SciPy's annealing and gradient descent through Mitsuba."""
    from benchmarks.albedo_peers_slow import SLOW_PEERS

    def peer(name: str, method: Any) -> Peer:
        def run(scene: SyntheticScene) -> Outcome:
            answer, cost = timed(lambda: method(scene.image, len(scene.lights)))
            return albedo_errors(scene, answer.albedo_value, cost, answer.evaluations)

        return Peer(MITSUBA, run, missing_mitsuba()) if name == MITSUBA else Peer(f"SciPy {name}", run)

    return [peer(name, method) for name, method in SLOW_PEERS.items()]


def missing_mitsuba() -> str:
    """Return what Mitsuba's gradients lack, found out in a process of its own: an unfit libLLVM aborts it."""
    if lacking := missing_modules("mitsuba"):
        return lacking
    done = subprocess.run(
        [sys.executable, "-c", MITSUBA_TRIAL], cwd=Path(__file__).parent, capture_output=True, check=False
    )
    return "a libLLVM of version 19 named by DRJIT_LIBLLVM_PATH" if done.returncode else ""


def glasses_peers() -> list[Peer]:
    """Return Adam on the same loss, its outlines traced once from where labels alone lead."""
    from bench.eyeglasses.registration import SameLoss

    def peer(iterations: int) -> Peer:
        def run(scene: WornGlasses) -> Outcome:
            problem = SameLoss(scene)
            state, cost = timed(lambda: problem.adam_state(ADAM_STEP_MM, iterations))
            vertices = problem.vertices(state)
            return Outcome(cost, (rms_mm(vertices, scene.worn),), iterations)

        return Peer(f"Adam, {iterations} steps", run)

    return [peer(iterations) for iterations in ADAM_ITERATIONS]


def parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    made = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    made.add_argument("stages", nargs="*", metavar="STAGE", help=f"{', '.join(STAGES)}; all when omitted")
    made.add_argument("-o", "--out", type=Path, default=Path("benchmark_out"))
    made.add_argument("--quick", action="store_true", help="tiny scenes: to see that it runs")
    made.add_argument("--repeats", type=int, default=1, help="runs of each setting; the cheapest counts")
    made.add_argument("--peers-python", default=sys.executable, help="a Python that has trimesh and rtree")
    made.add_argument("--no-slow", action="store_true", help="without annealing, Mitsuba and Adam")
    made.add_argument("--no-budgets", action="store_true", help="do not check budgets in seconds")
    made.add_argument("--json", action="store_true", help="print all numbers as JSON on stdout")
    return made


def main(words: list[str] | None = None) -> None:
    arguments = parser().parse_args(words)
    if unknown := [name for name in arguments.stages if name not in STAGES]:
        parser().error(f"{unknown[0]!r} is none of {', '.join(STAGES)}")
    if arguments.repeats < 1:
        parser().error(f"--repeats is {arguments.repeats}, expected at least 1")
    more: dict[str, list[Peer]] = {}
    if arguments.peers_python != sys.executable:
        more["fit"] = mesh_peers(arguments.peers_python)
    if not arguments.no_slow:
        more["albedo"], more["glasses"] = albedo_peers(), glasses_peers()
    with removed_if_empty(arguments.out):
        check_writable(arguments.out)
        report = run_benchmarks(
            tuple(dict.fromkeys(arguments.stages)),
            quick=arguments.quick,
            repeats=arguments.repeats,
            budgets=not arguments.no_budgets,
            more_peers=more,
            on_point=lambda stage, p: print(f"{stage}: {p.line()}", file=sys.stderr, flush=True),
            on_budget=lambda row: print(row.text(), file=sys.stderr, flush=True),
        )
        files = write_benchmarks(report, arguments.out)
    print(f"files: {', '.join(map(str, files))}", file=sys.stderr)
    print(json.dumps(plain_json(report.figures()), indent=2) if arguments.json else report.text())


if __name__ == "__main__":
    main()
