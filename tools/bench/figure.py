"""The picture of a bench: error against run time, the Pareto front and its knee."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.pareto import knee, pareto_front
from bench.runner import ALL, CPU, Bench, Summary
from scan2albedo.core.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEAST_S = 1e-4
LEAST_ERROR = 1e-6
"""What less counts as, for logarithms."""


def draw(benches: Mapping[str, tuple[Bench, Summary]], path: Path) -> None:
    """Draw mean error against mean CPU seconds of every method, a panel a bench."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6 * len(benches), 4.5), layout="constrained")
    panels = figure.subplots(1, len(benches), squeeze=False)[0]
    for axis, (title, (bench, summary)) in zip(panels, benches.items(), strict=True):
        means = {method: figures["mean"] for method, figures in summary[ALL].items()}
        error = bench.error or next(iter(next(iter(means.values()))))
        means = {method: mean for method, mean in means.items() if error in mean and CPU in mean}
        cpu_s = np.array([max(mean[CPU], LEAST_S) for mean in means.values()])
        wrong = np.array([max(mean[error], LEAST_ERROR) for mean in means.values()])
        _panel(axis, list(means), cpu_s, wrong, np.array([name not in bench.peers for name in means]))
        axis.set(title=title, xlabel="CPU time [s]", ylabel=error, xscale="log", yscale="log")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def _panel(axis: Axes, names: list[str], cpu_s: FloatArray, wrong: FloatArray, ours: BoolArray) -> None:
    """Draw ours and others' methods, their front and its knee; name the front, the first and the others'."""
    front = np.flatnonzero(pareto_front(cpu_s, wrong))
    front = front[np.argsort(cpu_s[front])]
    axis.plot(cpu_s[front], wrong[front], "-", color="0.6", label="Pareto front")
    axis.plot(cpu_s[ours], wrong[ours], "o", label="scan2albedo")
    axis.plot(cpu_s[~ours], wrong[~ours], "s", label="other methods")
    bend = knee(cpu_s, wrong)
    if bend is not None:
        axis.plot(cpu_s[bend], wrong[bend], "o", markersize=13, markerfacecolor="none", label="knee")
    for k in {0, *front.tolist(), *np.flatnonzero(~ours).tolist()}:
        axis.annotate(names[k], (cpu_s[k], wrong[k]), (4, 4), textcoords="offset points", fontsize=7)
    axis.legend(fontsize=8)
