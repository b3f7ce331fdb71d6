"""Rows and summaries of a bench as text."""

from collections.abc import Mapping, Sequence

from bench.runner import ALL, Bench, Row, Summary

NAME_WIDTH = 34
METHOD_WIDTH = 24


class Printer:
    """Prints rows as they are done, with a heading wherever their columns change."""

    def __init__(self) -> None:
        self.columns: list[str] = []

    def show(self, row: Row) -> None:
        """Print a row of one case."""
        if row.failed:
            print(f"{row.case:{NAME_WIDTH}} {row.method:{METHOD_WIDTH}} - {row.note}", flush=True)
        else:
            self.line(row.case, row.method, row.values, row.note)

    def line(self, name: str, method: str, values: Mapping[str, float], note: str = "") -> None:
        """Print numbers below the heading of their columns."""
        if not set(values) <= set(self.columns):
            self.columns = list(values)
            heading = "".join(f" {name:>{_width(name)}}" for name in self.columns)
            print(f"\n{'':{NAME_WIDTH}} {'':{METHOD_WIDTH}}{heading}")
        cells = (f"{values[key]:.4g}" if key in values else "-" for key in self.columns)
        numbers = "".join(f" {cell:>{_width(key)}}" for key, cell in zip(self.columns, cells, strict=True))
        print(f"{name:{NAME_WIDTH}} {method:{METHOD_WIDTH}}{numbers}  {note}".rstrip(), flush=True)


def _width(column: str) -> int:
    return max(8, len(column))


def print_summary(bench: Bench, summary: Summary, rows: Sequence[Row]) -> None:
    """Print the summaries that a bench asks for, of each group and of all, and its remarks."""
    printer = Printer()
    for group, methods in summary.items():
        if group == ALL and len(summary) == 2:
            # They are those of the only group.
            continue
        for method, figures in methods.items():
            for title in bench.summaries:
                name = title if group == ALL else f"{title} {group}"
                printer.line(name, method, figures[title], f"n {max(figures['n'].values(), default=0):g}")
    if bench.remarks is not None:
        print(*bench.remarks(rows), sep="\n")
