"""The curves: error against CPU time, one panel a stage and kind of error, all methods on the same axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
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
_HEIGHT, _LETTER, _BESIDE, _MARKER = 0.024, 0.0142, 0.025, 0.018
"""Half of a label's height, width of a letter, distance of a label and half a marker; the panel is 1."""


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
    _write(axis, labels, front, kind)
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
    """The place of a label, a marker or a piece of a line in the panel, whose sides are 1."""

    left: float
    right: float
    low: float
    high: float

    @classmethod
    def around(cls, x: float, y: float, across: float, up: float) -> _Box:
        """Return the box of half width `across` and half height `up` around a point."""
        return cls(x - across, x + across, y - up, y + up)

    def distance(self, x: float, y: float) -> float:
        """Return its distance from a point."""
        return float(np.hypot(max(self.left - x, x - self.right, 0.0), max(self.low - y, y - self.high, 0.0)))

    def meets(self, other: _Box) -> bool:
        """Return whether two of them would touch."""
        beside = self.left < other.right and other.left < self.right
        return beside and self.low < other.high and other.low < self.high


def _write(
    axis: Axes, labels: Sequence[tuple[float, float, str, str]], front: Sequence[Point], kind: int
) -> None:
    """Write the labels beside their points: on no label, point, line to a label, or line of the front."""
    from matplotlib import patheffects

    to_axes = axis.transData + axis.transAxes.inverted()
    places = [(*to_axes.transform((x, y)), text, color) for x, y, text, color in labels]
    taken = [_Box.around(x, y, _MARKER, _MARKER) for x, y, _, _ in places]
    corners = [tuple(to_axes.transform(place)) for place in zip(*_places(front, kind), strict=True)]
    for start, end in pairwise(corners):
        taken += _along(start, end)
    told: list[_Box] = []
    for x, y, text, color in sorted(places, key=lambda p: -p[1]):
        box, line = _free_box(x, y, _LETTER * len(text), taken, told)
        taken += [box, *line]
        told += [box, *line]
        style = {"arrowstyle": "-", "color": color, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3}
        axis.annotate(
            text,
            (x, y),
            ((box.left + box.right) / 2, (box.low + box.high) / 2),
            xycoords="axes fraction",
            textcoords="axes fraction",
            fontsize=8,
            color=color,
            ha="center",
            va="center",
            zorder=8,
            path_effects=[patheffects.withStroke(linewidth=2.5, foreground="white")],
            arrowprops=style if line else None,
        )


def _along(start: tuple[float, ...], end: tuple[float, ...]) -> list[_Box]:
    """Return small boxes along a line."""
    count = max(2, int(np.hypot(end[0] - start[0], end[1] - start[1]) / 0.01))
    return [_Box.around(x, y, 0.003, 0.005) for x, y in np.linspace(start, end, count)]


def _free_box(
    x: float, y: float, width: float, taken: Sequence[_Box], told: Sequence[_Box]
) -> tuple[_Box, list[_Box]]:
    """Return the box of `width` nearest to a point that meets none of `taken`, and its line if it is far.

    The line meets none of the labels and lines `told`, where that can be. To the right of the point where
    nothing is free.
    """
    beside = _Box(x + _BESIDE, x + _BESIDE + width, y - _HEIGHT, y + _HEIGHT)
    shifts = [0.0, -2 * _BESIDE - width, *np.linspace(-0.45 - width, 0.4, 30)]
    steps = [0.0, *(sign * 0.4 * n * _HEIGHT for n in range(1, 90) for sign in (-1, 1))]
    places = [
        _Box(beside.left + dx, beside.right + dx, beside.low + dy, beside.high + dy)
        for dy in steps
        for dx in shifts
    ]
    free = [
        (box.distance(x, y) + 0.5 * abs(box.low - beside.low), box)
        for box in places
        if min(box.left, box.low) > 0
        and max(box.right, box.high) < 1
        and not any(box.meets(other) for other in taken)
    ]
    if not free:
        return beside, []
    free.sort(key=lambda place: place[0])
    for _, box in free:
        line = [] if box.distance(x, y) < 1.5 * _BESIDE else _to_label(x, y, box)
        if not any(piece.meets(other) for piece in line for other in told):
            return box, line
    return free[0][1], _to_label(x, y, free[0][1])


def _to_label(x: float, y: float, box: _Box) -> list[_Box]:
    """Return the line from a point to the middle of a label, from beyond its marker to before the label."""
    pieces = _along((x, y), ((box.left + box.right) / 2, (box.low + box.high) / 2))
    around = _Box.around(x, y, _MARKER + 0.005, _MARKER + 0.005)
    return [piece for piece in pieces if not (piece.meets(around) or piece.meets(box))]


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
