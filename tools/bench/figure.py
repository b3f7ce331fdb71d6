"""The picture of a bench: error against run time, the Pareto front and its knee."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bench.pareto import knee, pareto_front
from bench.runner import ALL, CPU, Bench, Summary


def draw(benches: Mapping[str, tuple[Bench, Summary]], path: Path) -> None:
    """Draw mean error against mean CPU seconds of every method, a panel a bench."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6 * len(benches), 4.5), layout="constrained")
    panels = figure.subplots(1, len(benches), squeeze=False)[0]
    for axis, (title, (bench, summary)) in zip(panels, benches.items(), strict=True):
        means = {method: figures["mean"] for method, figures in summary[ALL].items()}
        error = bench.error or next(iter(next(iter(means.values()))))
        means = {method: mean for method, mean in means.items() if error in mean and CPU in mean}
        names = list(means)
        cpu_s = np.array([max(mean[CPU], 1e-4) for mean in means.values()])
        wrong = np.array([max(mean[error], 1e-6) for mean in means.values()])
        front = np.flatnonzero(pareto_front(cpu_s, wrong))
        front = front[np.argsort(cpu_s[front])]
        bend = knee(cpu_s, wrong)
        ours = np.array([name not in bench.peers for name in names])
        axis.plot(cpu_s[front], wrong[front], "-", color="0.6", label="Pareto front")
        axis.plot(cpu_s[ours], wrong[ours], "o", label="scan2albedo")
        axis.plot(cpu_s[~ours], wrong[~ours], "s", label="other methods")
        if bend is not None:
            axis.plot(cpu_s[bend], wrong[bend], "o", markersize=13, markerfacecolor="none", label="knee")
        labelled = {*front.tolist(), 0, *np.flatnonzero(~ours).tolist()}
        for k in labelled:
            axis.annotate(names[k], (cpu_s[k], wrong[k]), (4, 4), textcoords="offset points", fontsize=7)
        axis.set(title=title, xlabel="CPU time [s]", ylabel=error, xscale="log", yscale="log")
        axis.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
