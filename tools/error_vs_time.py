"""Error against run time of every stage, with the slow peers too, in one run.

    OMP_NUM_THREADS=1 python tools/error_vs_time.py [STAGE ...] [-o OUT] [--quick] [--repeats 1]
        [--peers-python PYTHON] [--no-slow] [--no-budgets]

What `scan2albedo benchmark` does, and more peers: SciPy's annealing and Mitsuba's gradients for the albedo,
Adam for glasses, and, by `--peers-python`, trimesh's `nricp_*` from a Python that has rtree (`pip install
trimesh rtree` in an environment of its own). `--no-slow` leaves the first three out. Without them it takes
some 15 minutes of CPU.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

from scan2albedo.benchmarks.albedo import judged as judged_albedo
from scan2albedo.benchmarks.fitting import mesh_peers
from scan2albedo.benchmarks.glasses import WornGlasses, rms_mm
from scan2albedo.benchmarks.measurement import timed
from scan2albedo.benchmarks.run import STAGES, run_benchmarks, write_benchmarks
from scan2albedo.benchmarks.sweep import Outcome, Peer, missing_modules
from scan2albedo.synthetic import SyntheticScene

ADAM_ITERATIONS = (30, 300, 1500)
ADAM_STEP_MM = 0.3
MITSUBA = "Mitsuba gradients"
MITSUBA_TRIAL = """
from albedo_peers_slow import DescentOptions, mitsuba_inverse
from scan2albedo.synthetic import face
mitsuba_inverse(face(size=24).image, 1, DescentOptions(trial_steps=1, steps=1))
"""


def albedo_peers() -> list[Peer]:
    """Return SciPy's annealing and gradient descent through Mitsuba."""
    from albedo_peers_slow import SLOW_PEERS

    def peer(name: str, method: Any) -> Peer:
        def run(scene: SyntheticScene) -> Outcome:
            answer, cost = timed(lambda: method(scene.image, len(scene.lights)))
            return judged_albedo(scene, answer.albedo_value, cost, answer.evaluations)

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
    from eyeglasses_registration import SameLoss

    def peer(iterations: int) -> Peer:
        def run(scene: WornGlasses) -> Outcome:
            problem = SameLoss(scene)
            state, cost = timed(lambda: problem.adam_state(ADAM_STEP_MM, iterations))
            vertices = problem.vertices(state)
            return Outcome(cost, (rms_mm(vertices, scene.worn),), iterations)

        return Peer(f"Adam, {iterations} steps", run)

    return [peer(iterations) for iterations in ADAM_ITERATIONS]


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("stages", nargs="*", choices=[*STAGES, []], help="all when omitted")
    parser.add_argument("-o", "--out", type=Path, default=Path("benchmark_out"))
    parser.add_argument("--quick", action="store_true", help="tiny scenes")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each setting; the cheapest counts")
    parser.add_argument("--peers-python", default=sys.executable, help="a Python that has trimesh and rtree")
    parser.add_argument("--no-slow", action="store_true", help="without annealing, Mitsuba and Adam")
    parser.add_argument("--no-budgets", action="store_true")
    arguments = parser.parse_args()
    more: dict[str, list[Peer]] = {}
    if arguments.peers_python != sys.executable:
        more["fit"] = mesh_peers(arguments.peers_python)
    if not arguments.no_slow:
        more["albedo"], more["glasses"] = albedo_peers(), glasses_peers()
    report = run_benchmarks(
        arguments.stages,
        quick=arguments.quick,
        repeats=arguments.repeats,
        budgets=not arguments.no_budgets,
        more_peers=more,
        on_point=lambda stage, p: print(f"{stage}: {p.line()}", file=sys.stderr, flush=True),
        on_budget=lambda row: print(row.text(), file=sys.stderr, flush=True),
    )
    files = write_benchmarks(report, arguments.out)
    print(report.text())
    print(f"\nfiles: {', '.join(map(str, files))}", file=sys.stderr)


if __name__ == "__main__":
    main()
