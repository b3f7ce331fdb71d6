"""Axes of charts: ranges, ticks and where values lie."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

_ROOM = 0.04
"""Beyond the outermost values, in parts of their span."""
_LEAST_SPAN = 0.002
"""Of an axis, in parts of its greatest value."""
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)


@dataclass(frozen=True)
class Axis:
    """Values from `low` to `high` along `start` to `end` in the drawing's unit."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    @classmethod
    def of(cls, values: Sequence[float], start: float, end: float, *, log_from: float = math.inf) -> Axis:
        """Return the axis that holds all values, with some room; logarithmic from a ratio of `log_from`."""
        low, high = min(values), max(values)
        if low > 0 and high / low >= log_from:
            margin = (high / low) ** _ROOM
            return cls(low / margin, high * margin, start, end, True)
        # What hardly changes is drawn as a line that hardly rises.
        margin = max(_ROOM * (high - low), (_LEAST_SPAN * abs(high) - (high - low)) / 2) or 1.0
        return cls(low - margin, high + margin, start, end)

    def place(self, value: float) -> float:
        """Return where a value lies."""
        if self.log:
            part = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            part = (value - self.low) / (self.high - self.low)
        return round(self.start + part * (self.end - self.start), 2)

    def ticks(self, count: int = 5) -> list[float]:
        """Return about `count` round values inside the axis."""
        return self._log_ticks(count) if self.log else linear_ticks(self.low, self.high, count)

    def _log_ticks(self, count: int) -> list[float]:
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        decades = last - first
        factors = (1, 2, 5) if decades <= 2 else (1, 3) if decades <= 3 else (1,)
        every = max(1, -(-decades // (2 * count)))
        values = [
            factor * 10.0**power
            for power in range(first, last + 1)
            if (power - first) % every == 0
            for factor in factors
        ]
        inside = [value for value in values if self.low <= value <= self.high]
        return inside if len(inside) > 1 else linear_ticks(self.low, self.high, count)


def linear_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Return about `count` multiples of 1, 2, 2.5 or 5 times a power of ten between two values.

    >>> linear_ticks(0.0, 1.04)
    [0.0, 0.25, 0.5, 0.75, 1.0]
    """
    span = high - low
    if not span > 0:
        return [low]
    rough = span / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in _STEPS if factor * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) for k in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_text(value: float) -> str:
    """Return a tick's label.

    >>> [tick_text(v) for v in (0.0, 0.25, 1500.0, 3e-05, 2e7)]
    ['0', '0.25', '1,500', '3e-05', '2e+07']
    """
    size = abs(value)
    if size and (size >= 1e6 or size < 1e-3):
        return f"{value:.3g}"
    return f"{value:,.10g}" if size < 1 else f"{round(value, 6):,.10g}"
