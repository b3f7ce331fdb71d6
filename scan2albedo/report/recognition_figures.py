"""CMC and ROC curves with their intervals, as figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from scan2albedo.recognition import CmcCurve, RocCurve

_MOST_RANKS = 20
_MOST_BANDS, _BARS = 3, 6
"""Curves with a band each at most; bars of a curve where there are more."""
_FEW = 30
"""Probes, or genuine claims, below which a figure says so."""
_LABEL_CHARACTERS = 88
"""Of a line of the legend, at most."""
_THICKEST, _THINNEST = 4.0, 1.3
"""Widths, in points, of the first and the last of several curves: those below show beside those above."""


@dataclass(frozen=True)
class _Drawn:
    """A curve as it is drawn: rates `y` (N,) at `x` (N,), their interval, and what the legend says."""

    text: str
    x: NDArray[np.generic]
    y: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def is_same(self, other: _Drawn) -> bool:
        """Whether nothing in the figure but the name differs."""
        pairs = ((self.x, other.x), (self.y, other.y), (self.low, other.low), (self.high, other.high))
        return self.text == other.text and all(np.array_equal(a, b) for a, b in pairs)


def cmc_figure(curves: Mapping[str, CmcCurve]) -> Figure:
    """Return identification rate against rank, a curve a name; ValueError for none or mixed confidences.

    Names whose curves are the same have one together.
    """
    figure, axis = _figure(curves, "CMC", "rank", "probes whose person is among the first")
    drawn = {}
    for name, curve in curves.items():
        shown = curve.rank <= _MOST_RANKS
        first = f"{curve.rate[0]:.1%} ({curve.low[0]:.1%} to {curve.high[0]:.1%})"
        text = f"{curve.probes} probes: rank 1 {first}"
        drawn[name] = _Drawn(text, curve.rank[shown], curve.rate[shown], curve.low[shown], curve.high[shown])
    _draw(axis, drawn, min(curve.probes for curve in curves.values()), "probes", marker="o")
    last = max(min(int(curve.rank[-1]), _MOST_RANKS) for curve in curves.values())
    axis.set_xlim(0.8, last + 0.2)
    axis.set_xticks(sorted({1, *range(max(1, last // 4), last + 1, max(1, last // 4))}))
    figure.legend(loc="outside lower center", fontsize=9)
    return figure


def roc_figure(curves: Mapping[str, RocCurve]) -> Figure:
    """Return true over logarithmic false accept rate; ValueError for no curve or mixed confidences.

    False accept rates of less than one impostor's claim are left out. Names whose curves are the same have
    one together.
    """
    figure, axis = _figure(curves, "ROC", "false accept rate", "true accept rate")
    drawn = {}
    for name, curve in curves.items():
        shown = curve.supported
        least, most = curve.equal_error_interval
        equal = f"{curve.equal_error_rate:.2%} ({least:.2%} to {most:.2%})"
        text = f"{curve.genuine} genuine claims: equal error {equal}"
        rate, low, high = curve.true_accept_rate[shown], curve.low[shown], curve.high[shown]
        drawn[name] = _Drawn(text, curve.false_accept_rate[shown], rate, low, high)
    _draw(axis, drawn, min(curve.genuine for curve in curves.values()), "genuine claims")
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


def _draw(axis: Axes, curves: Mapping[str, _Drawn], count: int, what: str, marker: str = "") -> None:
    """Draw curves with their intervals: as bands, or as bars where the bands of many would cover each other.

    Curves that are the same are drawn once. No two have bars at the same x, where there is room. Later curves
    are thinner, so that earlier ones show at both their sides where they meet. The figure says when `count`,
    the number of what is counted, is small.
    """
    groups: list[tuple[list[str], _Drawn]] = []
    for name, curve in curves.items():
        names = next((names for names, other in groups if other.is_same(curve)), None)
        if names is None:
            groups.append(([name], curve))
        else:
            names.append(name)
    for number, (names, curve) in enumerate(groups):
        alike = ", one curve for all" if len(names) > 1 else ""
        text = f"{'; '.join(names)}{alike}, {curve.text}"
        label = fill(text, _LABEL_CHARACTERS, break_on_hyphens=False)
        width = _THINNEST + (_THICKEST - _THINNEST) * (1 - (number + 1) / len(groups))
        x, low, high = curve.x, curve.low, curve.high
        (line,) = axis.plot(x, curve.y, label=label, linewidth=width, marker=marker, markersize=width + 2.2)
        if len(groups) <= _MOST_BANDS:
            axis.fill_between(x, low, high, color=line.get_color(), alpha=0.18, linewidth=0)
            continue
        step = max(len(groups), len(x) // _BARS)
        bars = np.arange(number * step // len(groups) % len(x), len(x), step)
        axis.vlines(x[bars], low[bars], high[bars], color=line.get_color(), linewidth=1.2)
    if count < _FEW:
        few = f"{count} {what}: too few to tell much"
        axis.text(0.97, 0.05, few, transform=axis.transAxes, ha="right", fontsize=10, color="0.35")
