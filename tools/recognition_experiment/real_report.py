"""The tables and figures of a data set of people: by method and by condition."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from recognition_experiment.curve_figures import cmc_figure, roc_figure
from recognition_experiment.real import ALL, DataSet, people_counted
from recognition_experiment.report import MethodResult
from scan2albedo.io.atomic import atomic_path, make_folder, write_text
from scan2albedo.io.records import plain_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = (0.1, 0.01, 0.001, 0.0001)
"""False accept rates at which true accept rates are told, where enough impostors claim."""
Results = Mapping[tuple[str, str], Sequence[MethodResult]]


def figures_of(result: MethodResult) -> dict[str, Any]:
    """Return the figures of a method, plain numbers; rates at levels that the claims carry."""
    roc = result.roc
    at = {
        f"true_accept_rate_at_{level:g}": float(roc.true_accept_rate[_place(roc.false_accept_rate, level)])
        for level in carried_levels(roc.impostors)
    }
    return {
        "method": result.method,
        "probes": result.cmc.probes,
        "rank_1": result.rank_1,
        "rank_1_low": result.interval[0],
        "rank_1_high": result.interval[1],
        "equal_error_rate": roc.equal_error_rate,
        "equal_error_low": roc.equal_error_interval[0],
        "equal_error_high": roc.equal_error_interval[1],
        "separation": result.separation,
        "impostor_claims": roc.impostors,
        **at,
    }


def carried_levels(impostors: int) -> tuple[float, ...]:
    """Return the `LEVELS` of one impostor's claim or more.

    >>> carried_levels(380)
    (0.1, 0.01)
    """
    return tuple(level for level in LEVELS if level * impostors >= 1)


def _place(rates: np.ndarray, level: float) -> int:
    return max(int(np.searchsorted(rates, level * (1 + 1e-9), side="right")) - 1, 0)


def table(results: Results, data: DataSet) -> str:
    """Return the figures as text."""
    lines = [people_counted(data)]
    lines += [f"  left out: {name}: {reason}" for name, reason in data.failures.items()]
    for (condition, value), methods in results.items():
        levels = carried_levels(methods[0].roc.impostors)
        title = "all probes" if condition == ALL else f"{condition} {value}"
        head = "".join(f"{f'TAR at {level:.1%}':>14}" for level in levels)
        few = ", too few to tell much" if methods[0].cmc.probes < 30 else ""
        lines += [
            "",
            f"{title}: {methods[0].cmc.probes} probes{few}",
            f"  {'':35}{'rank 1':>7}  {'95 % interval':15}{'equal error':>11}  {'95 % interval':14}   d'"
            + head,
        ]
        for result in methods:
            figures = figures_of(result)
            rates = "".join(f"{figures[f'true_accept_rate_at_{level:g}']:14.0%}" for level in levels)
            lines.append(
                f"  {result.method:35}{result.rank_1:7.0%}  {_span(result.interval):15}"
                f"{result.roc.equal_error_rate:11.1%}  {_span(result.roc.equal_error_interval):14}"
                f"{result.separation:5.1f}{rates}"
            )
    return "\n".join(lines)


def _span(interval: tuple[float, float]) -> str:
    return f"{100 * interval[0]:.0f} to {100 * interval[1]:.0f}"


def write_real_report(results: Results, data: DataSet, out: Path) -> None:
    """Write table.txt, table.csv, real.json, cmc.png, roc.png and conditions.png.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    """
    folder = make_folder(out)
    rows = [
        {"condition": condition, "value": value, **figures_of(result)}
        for (condition, value), methods in results.items()
        for result in methods
    ]
    everybody = results[ALL, ""]
    drawn = {
        "cmc.png": cmc_figure({result.method: result.cmc for result in everybody}),
        "roc.png": roc_figure({result.method: result.roc for result in everybody}),
        "conditions.png": conditions_figure(results),
    }
    for name, figure in drawn.items():
        with atomic_path(folder / name) as temporary:
            figure.savefig(temporary)
    text = io.StringIO()
    columns = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, columns, lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / "table.csv", text.getvalue())
    write_text(folder / "table.txt", table(results, data) + "\n")
    whole = {"people": people_counted(data), "left_out": dict(data.failures), "results": rows}
    write_text(folder / "real.json", json.dumps(plain_json(whole), indent=2, allow_nan=False) + "\n")


def conditions_figure(results: Results) -> Figure:
    """Return rank-1 rate and equal error rate of each method with their intervals, a colour a condition."""
    from matplotlib.figure import Figure

    groups = list(results.items())
    methods = [result.method for result in groups[0][1]]
    figure = Figure(figsize=(9.5, 1.4 + 0.42 * len(methods)), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for k, ((condition, value), found) in enumerate(groups):
        places = np.arange(len(methods)) + 0.7 * ((k + 0.5) / len(groups) - 0.5)
        label = "all probes" if condition == ALL else f"{condition} {value}"
        label = f"{label} ({found[0].cmc.probes} probes)"
        rates = [(100 * r.rank_1, *(100 * np.array(r.interval))) for r in found]
        errors = [
            (100 * r.roc.equal_error_rate, *(100 * np.array(r.roc.equal_error_interval))) for r in found
        ]
        for axis, values in ((left, rates), (right, errors)):
            middle, low, high = np.array(values).T
            spread = np.maximum([middle - low, high - middle], 0)
            axis.errorbar(middle, places, xerr=spread, fmt="o", markersize=3.5, linewidth=1, label=label)
    left.set_yticks(range(len(methods)), methods, fontsize=8)
    left.set_ylim(len(methods) - 0.5, -0.5)
    left.set_xlabel("right at rank 1, %, with 95 % intervals")
    right.set_xlabel("equal error rate, %, with 95 % intervals")
    for axis in (left, right):
        axis.grid(alpha=0.3)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    return figure
