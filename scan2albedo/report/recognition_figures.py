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

_MOST_BANDS, _BARS = 3, 6
"""Curves with a band each at most; bars of a curve where there are more."""
_FEW = 30
"""Probes, or genuine claims, below which a figure says so."""


def cmc_figure(curves: Mapping[str, CmcCurve], *, most_ranks: int = 20) -> Figure:
    """Return identification rate against rank, a curve a name; ValueError for none or mixed confidences."""
    figure, axis = _figure(curves, "CMC", "rank", "probes whose person is among the first")
    for k, (name, curve) in enumerate(curves.items()):
        shown = curve.rank <= most_ranks
        first = f"{curve.rate[0]:.1%} ({curve.low[0]:.1%} to {curve.high[0]:.1%})"
        label = f"{name}, {curve.probes} probes: rank 1 {first}"
        place = (k, len(curves))
        rate, low, high = curve.rate[shown], curve.low[shown], curve.high[shown]
        _draw(axis, curve.rank[shown], rate, low, high, label, place, marker="o")
    _tell_few(axis, min(curve.probes for curve in curves.values()), "probes")
    last = max(min(int(curve.rank[-1]), most_ranks) for curve in curves.values())
    axis.set_xlim(0.8, last + 0.2)
    axis.set_xticks(sorted({1, *range(max(1, last // 4), last + 1, max(1, last // 4))}))
    figure.legend(loc="outside lower center", fontsize=9)
    return figure


def roc_figure(curves: Mapping[str, RocCurve]) -> Figure:
    """Return true over logarithmic false accept rate; ValueError for no curve or mixed confidences.

    False accept rates of less than one impostor's claim are left out.
    """
    figure, axis = _figure(curves, "ROC", "false accept rate", "true accept rate")
    for k, (name, curve) in enumerate(curves.items()):
        shown = curve.carried
        least, most = curve.equal_error_interval
        equal = f"{curve.equal_error_rate:.2%} ({least:.2%} to {most:.2%})"
        label = f"{name}, {curve.genuine} genuine claims: equal error {equal}"
        rate, low, high = curve.true_accept_rate[shown], curve.low[shown], curve.high[shown]
        _draw(axis, curve.false_accept_rate[shown], rate, low, high, label, (k, len(curves)))
    _tell_few(axis, min(curve.genuine for curve in curves.values()), "genuine claims")
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
    place: tuple[int, int],
    marker: str = "",
) -> None:
    """Draw a curve with its interval: as a band, or as bars where the bands of many would cover each other.

    `place` is the curve's number among how many; no two curves have bars at the same x, where there is room.
    """
    number, count = place
    (line,) = axis.plot(x, y, label=label, marker=marker, markersize=3.5)
    if count <= _MOST_BANDS:
        axis.fill_between(x, low, high, color=line.get_color(), alpha=0.18, linewidth=0)
        return
    step = max(count, len(x) // _BARS)
    bars = np.arange(number * step // count % len(x), len(x), step)
    axis.vlines(x[bars], low[bars], high[bars], color=line.get_color(), linewidth=1.2)


def _tell_few(axis: Axes, count: int, what: str) -> None:
    if count < _FEW:
        told = f"{count} {what}: too few to tell much"
        axis.text(0.97, 0.05, told, transform=axis.transAxes, ha="right", fontsize=10, color="0.35")
