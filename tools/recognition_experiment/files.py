"""The files of a recognition experiment: figures, curves, and a sheet of people."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING

from recognition_experiment.curve_figures import cmc_figure, roc_figure
from recognition_experiment.people import people_figure
from recognition_experiment.report import RecognitionReport
from recognition_experiment.sessions import TEXTURE, cached_session
from scan2albedo.io.atomic import atomic_path, make_folder, write_text
from scan2albedo.io.records import plain_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RECORD = "recognition.json"
PEOPLE_SHOWN, SCANS_SHOWN = 6, 2


def write_report(report: RecognitionReport, out: str | Path, cache: str | Path | None = None) -> Path:
    """Write what the experiment found into a folder and return it.

    ``recognition.json`` (all figures), ``table.txt``, ``probes.csv`` (who was taken for whom by each
    method), ``cmc.png``, ``roc.png``, ``trace.csv``, ``error_vs_time.png``, and with the experiment's
    cache ``people.png``. A run that had nothing left to do leaves the trace of the one before.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    """
    folder = make_folder(out)
    figures = {
        "cmc.png": cmc_figure({result.method: result.cmc for result in report.results}),
        "roc.png": roc_figure({result.method: result.roc for result in report.results}),
    }
    if len(report.trace):
        figures["error_vs_time.png"] = report.trace.plot()
        write_text(folder / "trace.csv", report.trace.to_csv())
    if cache is not None and (people := _people(report, Path(cache))) is not None:
        figures["people.png"] = people
    for name, figure in figures.items():
        with atomic_path(folder / name) as temporary:
            figure.savefig(temporary)
    write_text(folder / "table.txt", report.table() + "\n")
    write_text(folder / "probes.csv", _probes(report))
    write_text(folder / RECORD, json.dumps(plain_json(report.figures()), indent=2, allow_nan=False) + "\n")
    return folder


def _probes(report: RecognitionReport) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["person", *(result.method for result in report.results)])
    names = report.results[0].identification.probe_names
    taken_for = [result.identification.predicted for result in report.results]
    writer.writerows(zip(names, *taken_for, strict=True))
    return text.getvalue()


def _people(report: RecognitionReport, cache: Path) -> Figure | None:
    shown = (TEXTURE, report.options.brdfs[0])
    columns = [f"{name}, scan {scan}" for scan in range(SCANS_SHOWN) for name in shown]
    rows = {}
    for person in report.persons[:PEOPLE_SHOWN]:
        scans = [cached_session(cache, report.options, person, scan) for scan in range(SCANS_SHOWN)]
        if all(scan is not None and not scan.failure for scan in scans):
            rows[f"person {person}"] = [s.images[name] for s in scans if s for name in shown]
    return people_figure(rows, columns) if rows else None
