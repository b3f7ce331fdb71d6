"""What a stage's sweep found: front, knee, table, CSV and plain numbers."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from benchmarks.pareto import knee, pareto_front
from benchmarks.sweep import ErrorKind, Point

_NAME_WIDTH = 40
_COLUMNS = (
    *("stage", "method", "knob", "value", "error_name", "unit", "error", "worst"),
    *("cpu_s", "wall_s", "evaluations", "front", "knee"),
)


@dataclass(frozen=True)
class StageReport:
    """The points of one stage.

    Parameters
    ----------
    stage : str
    errors : tuple of ErrorKind
    points : tuple of Point
    scenes : int
        How many each point is a mean of.
    missing : tuple of (str, str)
        Peers that are not installed, and what installs them.
    """

    stage: str
    errors: tuple[ErrorKind, ...]
    points: tuple[Point, ...]
    scenes: int = 1
    missing: tuple[tuple[str, str], ...] = ()

    @cached_property
    def ours(self) -> tuple[Point, ...]:
        """The library's own points, cheapest first."""
        return tuple(sorted((p for p in self.points if p.is_ours), key=_by_time))

    @property
    def peers(self) -> tuple[Point, ...]:
        """The others', cheapest first."""
        return tuple(sorted((p for p in self.points if not p.is_ours), key=_by_time))

    def front(self, kind: int = 0) -> tuple[Point, ...]:
        """Return the library's points to which no other is equal or better in both, cheapest first."""
        on = pareto_front([p.cpu_s for p in self.ours], [p.errors[kind] for p in self.ours])
        return tuple(p for p, chosen in zip(self.ours, on, strict=True) if chosen)

    def knee(self, kind: int = 0) -> Point | None:
        """Return the point of the front at which more time stops to pay, see `pareto.knee`."""
        at = knee([p.cpu_s for p in self.ours], [p.errors[kind] for p in self.ours])
        return None if at is None else self.ours[at]

    @property
    def default(self) -> Point | None:
        """The point of the default options."""
        return next((p for p in self.ours if p.knob == "default"), None)

    def marks(self, point: Point) -> str:
        """Return what is to be said about a point: fronts, knees, default, preset."""
        words = []
        for number, kind in enumerate(self.errors):
            of = f" of {kind.name}" if len(self.errors) > 1 else ""
            if point.is_ours and point is self.knee(number):
                words.append(f"knee{of}")
            elif point.is_ours and point in self.front(number):
                words.append(f"front{of}")
        if point.is_ours and point.knob in ("default", "preset"):
            words.append("default" if point.knob == "default" else f"preset {point.value}")
        if point.is_ours and not point.errors[0] >= 0:
            words.append("failed")
        if not point.is_ours:
            words.append(self.beaten_by(point))
        return ", ".join(words)

    def beaten_by(self, peer: Point) -> str:
        """Return how our cheapest point that is not worse than a peer in the first error compares with
        it."""
        if not peer.errors[0] >= 0:
            return "failed"
        better = [p for p in self.ours if p.errors[0] <= peer.errors[0]]
        if not better:
            return "more exact than all of ours"
        ratio = min(p.cpu_s for p in better) / max(peer.cpu_s, 1e-9)
        return f"ours as good or better in {ratio:.2g} x its time"

    def table(self) -> str:
        """Return the rows, cheapest first, as text."""
        names = tuple(dict.fromkeys(name for p in self.points for name in p.details))
        heads = "".join(f"{f'{k.name} [{k.unit}]':>{_width(k)}}{'worst':>10}" for k in self.errors)
        head = (
            f"{'':{_NAME_WIDTH}}{heads}{'CPU s':>9}{'wall s':>9}{'evals':>8}"
            + "".join(f"{name:>{_wide(name)}}" for name in names)
            + "  what it is"
        )
        lines = [f"{self.stage}: means over {self.scenes} scenes, cheapest first", head, "-" * len(head)]
        for point in sorted(self.points, key=_by_time):
            lines.append(self._row(point, names))
        lines += [f"not installed: {name}: {hint}" for name, hint in self.missing]
        return "\n".join(lines)

    def _row(self, point: Point, names: Sequence[str]) -> str:
        errors = "".join(
            f"{error:{_width(kind)}.4g}{worst:10.4g}"
            for kind, error, worst in zip(self.errors, point.errors, point.worst, strict=True)
        )
        return (
            f"{point.name[: _NAME_WIDTH - 1]:{_NAME_WIDTH}}{errors}{point.cpu_s:9.3f}{point.wall_s:9.3f}"
            f"{point.evaluations:8.0f}"
            + "".join(f"{point.details.get(name, float('nan')):{_wide(name)}.4g}" for name in names)
            + f"  {self.marks(point)}"
        ).rstrip()

    def figures(self) -> dict[str, Any]:
        """Return all as plain numbers for JSON."""
        return {
            "stage": self.stage,
            "scenes": self.scenes,
            "errors": [vars(kind) for kind in self.errors],
            "points": [
                {**vars(p), "name": p.name, "details": dict(p.details), "marks": self.marks(p)}
                for p in self.points
            ],
            "front": [[p.name for p in self.front(n)] for n in range(len(self.errors))],
            "knee": [None if (k := self.knee(n)) is None else k.name for n in range(len(self.errors))],
            "missing": [{"peer": name, "install": hint} for name, hint in self.missing],
        }


def _by_time(point: Point) -> tuple[bool, float]:
    """Sort by time, what failed last."""
    failed = not point.cpu_s >= 0
    return failed, 0.0 if failed else point.cpu_s


def _width(kind: ErrorKind) -> int:
    return max(12, len(kind.name) + len(kind.unit) + 5)


def _wide(name: str) -> int:
    return max(9, len(name) + 2)


def csv_text(reports: Sequence[StageReport]) -> str:
    """Return one row for each point and kind of error."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for report in reports:
        for number, kind in enumerate(report.errors):
            front, bend = report.front(number), report.knee(number)
            for p in report.points:
                row = [report.stage, p.method, p.knob, p.value, kind.name, kind.unit]
                row += [f"{v:.6g}" for v in (p.errors[number], p.worst[number], p.cpu_s, p.wall_s)]
                writer.writerow([*row, f"{p.evaluations:.6g}", int(p in front), int(p is bend)])
    return text.getvalue()
