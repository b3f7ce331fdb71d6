"""CMC and ROC curves with their intervals, as figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from textwrap import fill
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
_LABEL_CHARACTERS = 88
"""Of a line of the legend, at most."""
_THICKEST, _THINNEST = 4.0, 1.3
"""Widths, in points, of the first and the last of several curves: those below show beside those above."""


def cmc_figure(curves: Mapping[str, CmcCurve], *, most_ranks: int = 20) -> Figure:
    """Return identification rate against rank, a curve a name; ValueError for none or mixed confidences.

    Names whose curves are the same have one together.
    """
    figure, axis = _figure(curves, "CMC", "rank", "probes whose person is among the first")
    drawn = []
    for name, curve in curves.items():
        shown = curve.rank <= most_ranks
        first = f"{curve.rate[0]:.1%} ({curve.low[0]:.1%} to {curve.high[0]:.1%})"
        rate, low, high = curve.rate[shown], curve.low[shown], curve.high[shown]
        told = f"{curve.probes} probes: rank 1 {first}"
        drawn.append(_Drawn((name,), told, curve.rank[shown], rate, low, high))
    _draw(axis, drawn, marker="o")
    _tell_few(axis, min(curve.probes for curve in curves.values()), "probes")
    last = max(min(int(curve.rank[-1]), most_ranks) for curve in curves.values())
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
    drawn = []
    for name, curve in curves.items():
        shown = curve.carried
        least, most = curve.equal_error_interval
        equal = f"{curve.equal_error_rate:.2%} ({least:.2%} to {most:.2%})"
        rate, low, high = curve.true_accept_rate[shown], curve.low[shown], curve.high[shown]
        told = f"{curve.genuine} genuine claims: equal error {equal}"
        drawn.append(_Drawn((name,), told, curve.false_accept_rate[shown], rate, low, high))
    _draw(axis, drawn)
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


@dataclass(frozen=True)
class _Drawn:
    """A curve as it is drawn: rates `y` (N,) at `x` (N,), their interval, and what the legend tells."""

    names: tuple[str, ...]
    told: str
    x: NDArray[np.generic]
    y: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def label(self) -> str:
        """The legend's text."""
        names = "; ".join(self.names)
        alike = ", one curve for all" if len(self.names) > 1 else ""
        return fill(f"{names}{alike}, {self.told}", _LABEL_CHARACTERS, break_on_hyphens=False)

    def is_same(self, other: _Drawn) -> bool:
        """Whether nothing in the figure but the name differs."""
        pairs = ((self.x, other.x), (self.y, other.y), (self.low, other.low), (self.high, other.high))
        return self.told == other.told and all(np.array_equal(a, b) for a, b in pairs)


def _merged(curves: list[_Drawn]) -> list[_Drawn]:
    """Return one curve for all that are the same, with all their names."""
    merged: list[_Drawn] = []
    for curve in curves:
        same = next((k for k, other in enumerate(merged) if other.is_same(curve)), None)
        if same is None:
            merged.append(curve)
        else:
            merged[same] = replace(curve, names=merged[same].names + curve.names)
    return merged


def _draw(axis: Axes, curves: list[_Drawn], marker: str = "") -> None:
    """Draw curves with their intervals: as bands, or as bars where the bands of many would cover each other.

    No two curves have bars at the same x, where there is room. Later curves are thinner, so that earlier ones
    show at both their sides where they meet.
    """
    curves = _merged(curves)
    count = len(curves)
    for number, curve in enumerate(curves):
        width = _THINNEST + (_THICKEST - _THINNEST) * (1 - (number + 1) / count)
        size = width + 2.2
        x, low, high = curve.x, curve.low, curve.high
        (line,) = axis.plot(x, curve.y, label=curve.label, linewidth=width, marker=marker, markersize=size)
        if count <= _MOST_BANDS:
            axis.fill_between(x, low, high, color=line.get_color(), alpha=0.18, linewidth=0)
            continue
        step = max(count, len(x) // _BARS)
        bars = np.arange(number * step // count % len(x), len(x), step)
        axis.vlines(x[bars], low[bars], high[bars], color=line.get_color(), linewidth=1.2)


def _tell_few(axis: Axes, count: int, what: str) -> None:
    if count < _FEW:
        told = f"{count} {what}: too few to tell much"
        axis.text(0.97, 0.05, told, transform=axis.transAxes, ha="right", fontsize=10, color="0.35")
