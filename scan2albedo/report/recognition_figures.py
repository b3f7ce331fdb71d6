"""CMC and ROC curves with their intervals, as figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from scan2albedo.recognition import CmcCurve, RocCurve


def cmc_figure(curves: Mapping[str, CmcCurve], *, most_ranks: int = 20) -> Figure:
    """Return identification rate against rank, a curve a name; ValueError for none or mixed confidences."""
    figure, axis = _figure(curves, "CMC", "rank", "probes whose person is among the first")
    for name, curve in curves.items():
        shown = curve.rank <= most_ranks
        first = f"{curve.rate[0]:.1%} ({curve.low[0]:.1%} to {curve.high[0]:.1%})"
        label = f"{name}, {curve.probes} probes: rank 1 {first}"
        _draw(
            axis, curve.rank[shown], curve.rate[shown], curve.low[shown], curve.high[shown], label, marker="o"
        )
    last = max(min(int(curve.rank[-1]), most_ranks) for curve in curves.values())
    axis.set_xlim(0.8, last + 0.2)
    axis.set_xticks(sorted({1, *range(max(1, last // 4), last + 1, max(1, last // 4))}))
    figure.legend(loc="outside lower center", fontsize=9)
    return figure


def roc_figure(curves: Mapping[str, RocCurve]) -> Figure:
    """Return true over logarithmic false accept rate; ValueError for no curve or mixed confidences."""
    figure, axis = _figure(curves, "ROC", "false accept rate", "true accept rate")
    for name, curve in curves.items():
        shown = curve.false_accept_rate > 0
        least, most = curve.equal_error_interval
        equal = f"{curve.equal_error_rate:.2%} ({least:.2%} to {most:.2%})"
        label = f"{name}, {curve.genuine} genuine claims: equal error {equal}"
        rate, low, high = curve.true_accept_rate[shown], curve.low[shown], curve.high[shown]
        _draw(axis, curve.false_accept_rate[shown], rate, low, high, label)
    axis.set_xscale("log")
    figure.legend(loc="outside lower center", fontsize=9)
    return figure


def _figure(
    curves: Mapping[str, CmcCurve] | Mapping[str, RocCurve], title: str, x: str, y: str
) -> tuple[Figure, Axes]:
    if not curves:
        raise ValueError("no curve was given, expected one or more")
    confidences = {curve.confidence for curve in curves.values()}
    if len(confidences) > 1:
        raise ValueError(f"the curves' intervals have confidences {sorted(confidences)}, expected one")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.2), dpi=110, layout="constrained")
    axis = figure.subplots()
    axis.set_ylim(0, 1.02)
    axis.grid(alpha=0.3)
    axis.set_title(f"{title}, {confidences.pop():.0%} intervals", fontsize=11)
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    return figure, axis


def _draw(
    axis: Axes,
    x: NDArray[np.generic],
    y: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    label: str,
    marker: str = "",
) -> None:
    (line,) = axis.plot(x, y, label=label, marker=marker, markersize=3.5)
    axis.fill_between(x, low, high, color=line.get_color(), alpha=0.18, linewidth=0)
