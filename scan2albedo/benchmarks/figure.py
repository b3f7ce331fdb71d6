"""The curves: error against CPU time, one panel a stage and kind of error, all methods on the same axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from scan2albedo.benchmarks.report import StageReport
from scan2albedo.benchmarks.sweep import Point

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SWEPT, _FRONT, _DEFAULT, _KNEE, _PEER = "#b9cfe4", "#1f5f9e", "#111111", "#e0790b", "#b0283c"
_PRESETS = {"draft": "#2a8f4d", "best": "#7a3ea1"}
_COLUMNS = 3
_RING = {"markersize": 12, "markerfacecolor": "none", "markeredgecolor": _KNEE, "markeredgewidth": 2}
_APART = 0.055
"""Least distance of two labels, as a part of the panel's height."""


def draw(reports: Sequence[StageReport]) -> Figure:
    """Return the figure of all stages."""
    from matplotlib.figure import Figure

    panels = [(report, kind) for report in reports for kind in range(len(report.errors))]
    columns = min(_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(5.4 * columns, 4.1 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in axes[len(panels) :]:
        unused.set_axis_off()
    for axis, (report, kind) in zip(axes, panels, strict=False):
        _panel(axis, report, kind)
    _legend(figure)
    return figure


def _panel(axis: Axes, report: StageReport, kind: int) -> None:
    error = report.errors[kind]
    axis.set_title(f"{report.stage}: {error.name}", fontsize=11)
    axis.set_xlabel("CPU time [s]")
    axis.set_ylabel(f"[{error.unit}]")
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.grid(True, which="major", color="#dddddd", linewidth=0.7)
    axis.grid(True, which="minor", color="#f0f0f0", linewidth=0.5)
    axis.set_axisbelow(True)
    shown = [p for p in report.points if np.isfinite(p.errors[kind]) and p.cpu_s > 0]
    ours = [p for p in shown if p.is_ours]
    axis.plot(*_places(ours, kind), "o", color=_SWEPT, markersize=4.5, zorder=2)
    front = [p for p in report.front(kind) if p in shown]
    axis.plot(*_places(front, kind), "o-", color=_FRONT, markersize=4.5, linewidth=1.6, zorder=3)
    labels = _marked(axis, report, kind, shown)
    _limits(axis, shown, kind)
    _write(axis, labels)
    _plain_ticks(axis)


def _places(points: Sequence[Point], kind: int) -> tuple[list[float], list[float]]:
    return [p.cpu_s for p in points], [max(p.errors[kind], 1e-12) for p in points]


def _marked(
    axis: Axes, report: StageReport, kind: int, shown: Sequence[Point]
) -> list[tuple[float, float, str, str]]:
    """Draw knee, default, presets and peers; return the labels (x, y, text, colour)."""
    labels = []
    for peer in (p for p in shown if not p.is_ours):
        x, y = peer.cpu_s, max(peer.errors[kind], 1e-12)
        axis.plot(x, y, "s", color=_PEER, markersize=6, zorder=4)
        labels.append((x, y, peer.name, _PEER))
    for preset in (p for p in shown if p.knob == "preset"):
        x, y, color = preset.cpu_s, preset.errors[kind], _PRESETS.get(preset.value, _FRONT)
        axis.plot(x, y, "D", color=color, markersize=7.5, markeredgecolor="white", zorder=6)
        labels.append((x, y, preset.value, color))
    default = report.default
    if default is not None and default in shown:
        x, y = default.cpu_s, default.errors[kind]
        axis.plot(x, y, "*", color=_DEFAULT, markersize=14, markeredgecolor="white", zorder=7)
        labels.append((x, y, "default", _DEFAULT))
    bend = report.knee(kind)
    if bend is not None and bend in shown:
        x, y = bend.cpu_s, max(bend.errors[kind], 1e-12)
        axis.plot(x, y, "o", zorder=5, **_RING)  # type: ignore[arg-type]
        labels.append((x, y, f"knee: {bend.name}", _KNEE))
    return labels


def _limits(axis: Axes, shown: Sequence[Point], kind: int) -> None:
    """Leave room for labels to the right of the last point, and never less than half a decade."""
    x, y = (np.log10(v) for v in _places(shown, kind))
    for values, least, set_limits, after in (
        (x, 0.5, axis.set_xlim, 0.30),
        (y, 0.35, axis.set_ylim, 0.10),
    ):
        low, high = float(values.min()), float(values.max())
        missing = max(least - (high - low), 0.0) / 2
        span = high - low + 2 * missing
        set_limits(10 ** (low - missing - 0.08 * span), 10 ** (high + missing + after * span))


def _write(axis: Axes, labels: Sequence[tuple[float, float, str, str]]) -> None:
    """Write the labels beside their points, moved up or down until none lies on another."""
    to_axes = axis.transData + axis.transAxes.inverted()
    places = [(*to_axes.transform((x, y)), text, color) for x, y, text, color in labels]
    taken: list[tuple[float, float, float]] = []
    for x, y, text, color in sorted(places, key=lambda p: -p[1]):
        width = 0.019 * len(text)
        leftward = x + 0.03 + width > 1.0
        start = x - 0.025 - width if leftward else x + 0.025
        height = _free_height(y, start, start + width, taken)
        taken.append((height, start, start + width))
        axis.annotate(
            text,
            (x, y),
            (x - 0.025 if leftward else x + 0.025, height),
            xycoords="axes fraction",
            textcoords="axes fraction",
            fontsize=8,
            color=color,
            ha="right" if leftward else "left",
            va="center",
            zorder=8,
            arrowprops={"arrowstyle": "-", "color": color, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3}
            if abs(height - y) > 0.02
            else None,
        )


def _free_height(
    wanted: float, left: float, right: float, taken: Sequence[tuple[float, float, float]]
) -> float:
    """Return the height nearest to `wanted` at which a label from `left` to `right` is alone."""
    beside = [height for height, a, b in taken if a < right and left < b]
    steps = [0.0]
    for n in range(1, 40):
        steps += [-0.25 * n * _APART, 0.25 * n * _APART]
    for step in steps:
        height = wanted + step
        if 0.03 < height < 0.97 and all(abs(height - other) >= _APART for other in beside):
            return height
    return wanted


def _plain_ticks(axis: Axes) -> None:
    """Write 0.2 rather than 2 x 10^-1, and only as many numbers as there is room for."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for side, limits in ((axis.xaxis, axis.get_xlim()), (axis.yaxis, axis.get_ylim())):
        decades = float(np.log10(limits[1] / limits[0]))
        subs: tuple[float, ...] = (1.0, 2.0, 5.0) if decades < 2.5 else (1.0,)
        if decades < 0.8:
            subs = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
        side.set_major_locator(LogLocator(base=10, subs=subs, numticks=20))
        side.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        side.set_minor_formatter(NullFormatter())


def _legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    def line(label: str, **style: object) -> Line2D:
        return Line2D([], [], label=label, **{"linestyle": "none", **style})  # type: ignore[arg-type]

    figure.legend(
        handles=[
            line("settings of this library", marker="o", color=_SWEPT),
            line("their Pareto front", marker="o", color=_FRONT, linestyle="-"),
            line("its knee", marker="o", **_RING),
            line("default = standard", marker="*", color=_DEFAULT, markersize=13),
            line("draft", marker="D", color=_PRESETS["draft"]),
            line("best", marker="D", color=_PRESETS["best"]),
            line("other methods", marker="s", color=_PEER),
        ],
        loc="outside lower center",
        ncols=7,
        frameon=False,
    )
