"""The curves: error against CPU time, one panel a stage and kind of error, all methods on the same axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.report import StageReport
from benchmarks.sweep import Point

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SWEPT, _FRONT, _DEFAULT, _KNEE, _PEER = "#b9cfe4", "#1f5f9e", "#111111", "#e0790b", "#b0283c"
_PRESETS = {"draft": "#2a8f4d", "best": "#7a3ea1"}
_COLUMNS = 3
_RING = {"markersize": 12, "markerfacecolor": "none", "markeredgecolor": _KNEE, "markeredgewidth": 2}
_APART, _LETTER, _BESIDE, _MARKER = 0.055, 0.0150, 0.025, 0.018
"""Least distance of two labels, width of a letter, distance of a label and half a marker; the panel is 1."""


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
    labels, bend = [], report.knee(kind)
    for peer in (p for p in shown if not p.is_ours):
        x, y = peer.cpu_s, max(peer.errors[kind], 1e-12)
        axis.plot(x, y, "s", color=_PEER, markersize=6, zorder=4)
        labels.append((x, y, peer.name, _PEER))
    for preset in (p for p in shown if p.knob == "preset"):
        x, y, color = preset.cpu_s, preset.errors[kind], _PRESETS.get(preset.value, _FRONT)
        axis.plot(x, y, "D", color=color, markersize=7.5, markeredgecolor="white", zorder=6)
        labels.append((x, y, _with_knee(preset.value, preset is bend), color))
    default = report.default
    if default is not None and default in shown:
        x, y = default.cpu_s, default.errors[kind]
        axis.plot(x, y, "*", color=_DEFAULT, markersize=14, markeredgecolor="white", zorder=7)
        labels.append((x, y, _with_knee("default", default is bend), _DEFAULT))
    if bend is not None and bend in shown:
        x, y = bend.cpu_s, max(bend.errors[kind], 1e-12)
        axis.plot(x, y, "o", zorder=5, **_RING)  # type: ignore[arg-type]
        if bend.knob not in ("default", "preset"):
            labels.append((x, y, f"knee: {bend.name}", _KNEE))
    return labels


def _with_knee(name: str, is_knee: bool) -> str:
    return f"{name}, knee" if is_knee else name


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


@dataclass(frozen=True)
class _Box:
    """A label's or a marker's place in the panel, whose sides are 1."""

    left: float
    right: float
    height: float

    def meets(self, other: _Box) -> bool:
        """Return whether two labels would touch."""
        beside = self.left < other.right and other.left < self.right
        return beside and abs(self.height - other.height) < _APART


def _write(axis: Axes, labels: Sequence[tuple[float, float, str, str]]) -> None:
    """Write the labels beside their points, moved until none lies on another or on another's point."""
    from matplotlib import patheffects

    to_axes = axis.transData + axis.transAxes.inverted()
    places = [(*to_axes.transform((x, y)), text, color) for x, y, text, color in labels]
    taken = [_Box(x - _MARKER, x + _MARKER, y) for x, y, _, _ in places]
    for x, y, text, color in sorted(places, key=lambda p: -p[1]):
        box, is_left = _free_box(x, y, _LETTER * len(text), taken)
        taken.append(box)
        line = {"arrowstyle": "-", "color": color, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3}
        axis.annotate(
            text,
            (x, y),
            (box.right if is_left else box.left, box.height),
            xycoords="axes fraction",
            textcoords="axes fraction",
            fontsize=8,
            color=color,
            ha="right" if is_left else "left",
            va="center",
            zorder=8,
            path_effects=[patheffects.withStroke(linewidth=2.5, foreground="white")],
            arrowprops=line if abs(box.height - y) > 0.02 else None,
        )


def _free_box(x: float, y: float, width: float, taken: Sequence[_Box]) -> tuple[_Box, bool]:
    """Return the box of `width` nearest to a point that meets no other, and whether it is left of the point.

    To the right at the point's own height where nothing can be free.
    """
    steps = [0.0, *(sign * 0.2 * n * _APART for n in range(1, 60) for sign in (-1, 1))]
    for step in steps:
        for is_left in (False, True):
            left = x - _BESIDE - width if is_left else x + _BESIDE
            box = _Box(left, left + width, y + step)
            inside = left > 0 and left + width < 1 and 0.03 < box.height < 0.97
            if inside and not any(box.meets(other) for other in taken):
                return box, is_left
    return _Box(x + _BESIDE, x + _BESIDE + width, y), False


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
