"""Distributions of a batch's figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.report.html.axes import Axis, tick_text
from scan2albedo.report.html.texts import is_share, label_of, number_text, unit_of

WIDTH, HEIGHT = 300, 170
_LEFT, _RIGHT, _TOP, _BOTTOM = 34, 12, 18, 30
_BINS = 20
_LOG_FROM = 50.0
_MOST_WHOLE = 12


@dataclass(frozen=True)
class Bar:
    """A bar's place and what it counts."""

    x: float
    y: float
    width: float
    height: float
    count: int
    low: float
    high: float
    text: str


@dataclass(frozen=True)
class Histogram:
    """One column's distribution over the scans that have it."""

    column: str
    label: str
    unit: str
    bars: tuple[Bar, ...]
    ticks: tuple[tuple[float, str], ...]
    count_ticks: tuple[tuple[float, str], ...]
    median_at: float
    summary: str
    missing: int

    width, height, left, top = WIDTH, HEIGHT, _LEFT, _TOP
    right, bottom = WIDTH - _RIGHT, HEIGHT - _BOTTOM


def histogram(column: str, values: Sequence[float | None]) -> Histogram | None:
    """Return the distribution of a column's known values; None when fewer than two are known."""
    factor = 100.0 if is_share(column) else 1.0
    known = np.array([factor * value for value in values if value is not None])
    if len(known) < 2:
        return None
    edges, log = _edges(known)
    counts, _ = np.histogram(known, edges)
    axis = Axis(float(edges[0]), float(edges[-1]), _LEFT, WIDTH - _RIGHT, log)
    upward = Axis(0, float(counts.max()) or 1.0, HEIGHT - _BOTTOM, _TOP)
    unit = unit_of(column)
    whole = _is_whole(known)
    bars = [
        _bar(axis, upward, float(low), float(high), int(count), unit, whole)
        for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True)
    ]
    low, median, high = (float(v) for v in np.percentile(known, (5, 50, 95)))
    summary = f"median {number_text(median)}, 90 % within {number_text(low)} … {number_text(high)}"
    if known.min() == known.max():
        summary = f"all {number_text(median)}"
    ticks = [value for value in axis.ticks(4) if not whole or value == int(value)]
    return Histogram(
        column,
        label_of(column),
        unit,
        tuple(bars),
        tuple((axis.place(value), tick_text(value)) for value in ticks),
        tuple((upward.place(v), tick_text(v)) for v in upward.ticks(3) if v == int(v)),
        axis.place(median),
        summary,
        len(values) - len(known),
    )


def _is_whole(known: np.ndarray) -> bool:
    return bool((known == np.round(known)).all() and np.ptp(known) < _MOST_WHOLE)


def _edges(known: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the borders of the bins, and whether they are logarithmic."""
    low, high = float(known.min()), float(known.max())
    if _is_whole(known):
        return np.arange(low - 0.5, high + 1), False
    bins = int(np.clip(2 * np.sqrt(len(known)), 5, _BINS))
    if low > 0 and high / low >= _LOG_FROM:
        return np.geomspace(low, high, bins + 1), True
    if high - low <= 1e-9 * max(abs(high), 1e-300):
        half = 0.05 * abs(high) or 0.5
        return np.linspace(low - half, high + half, 4), False
    return np.linspace(low, high, bins + 1), False


def _bar(axis: Axis, upward: Axis, low: float, high: float, count: int, unit: str, whole: bool) -> Bar:
    left, right, top = axis.place(low), axis.place(high), upward.place(count)
    space = f" {unit}" if unit else ""
    where = number_text(round((low + high) / 2)) if whole else f"{number_text(low)} … {number_text(high)}"
    scans = "scan" if count == 1 else "scans"
    gap = 1.5 if right - left > 5 else 0.5
    return Bar(
        round(left + gap / 2, 2),
        top,
        round(right - left - gap, 2),
        round(HEIGHT - _BOTTOM - top, 2),
        count,
        low,
        high,
        f"{where}{space}: {count} {scans}",
    )
