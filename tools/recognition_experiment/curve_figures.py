"""CMC and ROC curves of several methods in one figure."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from scan2albedo.core.arrays import FloatArray
from scan2albedo.recognition import CmcCurve, RocCurve


def cmc_figure(curves: Mapping[str, CmcCurve]) -> Figure:
    """Return identification rate against the first 20 ranks; ValueError for no curve or mixed confidences.

    Names whose curves are the same have one together.
    """
    drawn = {}
    for name, curve in curves.items():
        first = f"{curve.rate[0]:.1%} ({curve.low[0]:.1%} to {curve.high[0]:.1%})"
        rows = np.stack([curve.rank, curve.rate, curve.low, curve.high])[:, :20]
        drawn[name] = f"{curve.probes} probes: rank 1 {first}", rows
    figure = _figure(curves, drawn, "CMC", "rank", "probes whose person is among the first", marker="o")
    figure.axes[0].xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def roc_figure(curves: Mapping[str, RocCurve]) -> Figure:
    """Return true over logarithmic false accept rate; ValueError for no curve or mixed confidences.

    False accept rates of less than one impostor's claim are left out. Names whose curves are the same have
    one together.
    """
    drawn = {}
    for name, curve in curves.items():
        least, most = curve.equal_error_interval
        equal = f"{curve.equal_error_rate:.2%} ({least:.2%} to {most:.2%})"
        rows = np.stack([curve.false_accept_rate, curve.true_accept_rate, curve.low, curve.high])
        drawn[name] = f"{curve.genuine} genuine claims: equal error {equal}", rows[:, curve.supported]
    figure = _figure(curves, drawn, "ROC", "false accept rate", "true accept rate")
    figure.axes[0].set_xscale("log")
    return figure


def _figure(
    curves: Mapping[str, CmcCurve] | Mapping[str, RocCurve],
    drawn: Mapping[str, tuple[str, FloatArray]],
    title: str,
    x_label: str,
    y_label: str,
    marker: str = "",
) -> Figure:
    """Draw curves of their text in the legend and rows x, y, low, high (4, N), the intervals as bars.

    No two curves have bars at the same x, where there is room. Later curves are thinner, so that earlier ones
    show at both their sides where they meet.
    """
    if not curves:
        raise ValueError("no curve was given, expected one or more")
    confidences = {curve.confidence for curve in curves.values()}
    if len(confidences) > 1:
        raise ValueError(f"the curves' intervals have confidences {sorted(confidences)}, expected one")
    figure = Figure(figsize=(6.5, 5), dpi=110, layout="constrained")
    axis = figure.subplots()
    axis.set(xlabel=x_label, ylabel=y_label)
    axis.set_title(f"{title}, {confidences.pop():.0%} intervals", fontsize=11)
    axis.grid(color="lightgray")
    alike: dict[tuple[str, bytes], list[str]] = {}
    for name, (text, rows) in drawn.items():
        alike.setdefault((text, rows.tobytes()), []).append(name)
    for number, ((text, _), names) in enumerate(alike.items()):
        x, y, low, high = drawn[names[0]][1]
        label = f"{'; '.join(names)}{', one curve for all' if len(names) > 1 else ''}, {text}"
        width = 1 + (len(alike) - number) / 2
        style: dict[str, Any] = {"linewidth": width, "marker": marker, "markersize": width + 2}
        (line,) = axis.plot(x, y, label=fill(label, 88, break_on_hyphens=False), **style)
        bars = np.arange(number % len(x), len(x), len(alike))
        axis.vlines(x[bars], low[bars], high[bars], color=line.get_color(), linewidth=1)
    axis.set_ylim(bottom=0)
    figure.legend(loc="outside lower center", fontsize=9)
    return figure
