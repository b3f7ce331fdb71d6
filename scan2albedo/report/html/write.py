"""`write_report`: one HTML file that shows what happened to a scan, or to a batch, and loads nothing."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scan2albedo.core.arrays import Values
from scan2albedo.core.version import VERSION
from scan2albedo.errors import OutputError, Scan2AlbedoError, needs_extra, one_line
from scan2albedo.io.atomic import write_text
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import ResultRecord
from scan2albedo.report.html import batch_section as batch
from scan2albedo.report.html.batch_section import DONE, RESULT_FILE
from scan2albedo.report.html.scan_section import scan_section

if TYPE_CHECKING:
    from jinja2 import Environment

REPORT_FILE = "report.html"
_SCRIPTS = (
    *("elements", "viewer_math", "viewer_shaders", "viewer_gl", "viewer_lights", "viewer_pointer", "viewer"),
    *("tables", "report"),
)
"""In the order in which they build on each other."""


@dataclass(frozen=True)
class WrittenReport:
    """Where a report is, and what it holds."""

    path: Path
    scans: int
    """In the table of the page at `path`, or 1; `done` and `failed` of them."""
    done: int
    failed: int
    sections: int
    """Scans that have a section of their own."""
    size_bytes: int
    """Of the page."""


def write_report(
    out: str | Path,
    path: str | Path | None = None,
    *,
    scans: int = 40,
    on_progress: Callable[[str], None] | None = None,
) -> WrittenReport:
    """Return what a self-contained HTML report of processed scans holds, which is written atomically.

    Raises `ValueError` when `scans` is negative; `Scan2AlbedoError` when the folder holds no result, or that
    of a single scan cannot be read; the message names the file; `OutputError` when the page cannot be
    written, or ``out/report.html`` is no such page.

    Parameters
    ----------
    out : path
        Folder of one processed scan (with result.json), of several such folders, or of a batch (with
        catalogue.parquet).
    path : path, optional
        The page; ``out/report.html`` when omitted. Links to files are relative to it.
    scans : int
        How many scans of a batch get a section of their own.
    on_progress : callable, optional
        Called with a line for each scan that is put into the page.
    """
    if scans < 0:
        raise ValueError(f"scans is {scans}, expected 0 or more")
    folder = Path(out)
    target = folder / REPORT_FILE if path is None else Path(path)
    if not folder.is_dir():
        raise Scan2AlbedoError(f"{folder}: no such folder; give OUT of process or batch, or OUT/<scan name>")
    if path is None and os.path.lexists(target):
        _refuse_foreign(target)
    single = (folder / RESULT_FILE).is_file() and not (folder / batch.CATALOGUE_FILE).is_file()
    chosen: tuple[int, ...] = (0,)
    if single:
        name = read_record(folder / RESULT_FILE, ResultRecord).name
        rows, reason = [batch.ScanRow(name, DONE, folder=folder)], ""
    else:
        catalogue = folder / batch.CATALOGUE_FILE
        rows = batch.rows_of_catalogue(catalogue) if catalogue.is_file() else batch.rows_of_folders(folder)
        name = folder.resolve().name or str(folder)
        chosen, reason = batch.selected_rows(rows, scans)
    topologies: dict[str, Values] = {}
    anchors, sections, not_shown = dict[int, str](), list[Values](), list[tuple[str, str]]()
    for k in chosen:
        scan, where = rows[k].name, rows[k].folder
        assert where is not None
        anchor = "scan" if single else f"scan-{k + 1}"
        if on_progress is not None and not single:
            on_progress(f"{scan}: {len(sections) + 1} of {len(chosen)}")
        try:
            record = read_record(where / RESULT_FILE, ResultRecord)
            section = scan_section(where, record, target, topologies, single=single, anchor=anchor, name=scan)
            sections.append(section)
            anchors[k] = anchor
        except Scan2AlbedoError as error:
            if single:
                raise
            not_shown.append((scan, one_line(error)))
    page = {
        "title": name,
        "written": datetime.now().astimezone().isoformat(" ", "minutes"),
        "scans": sections,
        "topologies": topologies,
        "batch": None if single else batch.batch_section(rows, anchors, target),
        "selection": reason,
        "not_shown": not_shown,
    }
    text = _rendered(page)
    write_text(target, text)
    done, failed = (sum(row.status == status for row in rows) for status in (DONE, batch.FAILED))
    return WrittenReport(target, len(rows), done, failed, len(sections), len(text.encode()))


def _rendered(page: Values) -> str:
    """Return the page, whose policy forbids all but its own style and script."""
    style, scripts = _static("report.css"), "\n".join(_static(f"{file}.js") for file in _SCRIPTS)
    script = f'\n(() => {{\n"use strict";\n{scripts}}})();\n'
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (style, script))
    policy = (
        "default-src 'none'; img-src data:; style-src 'sha256-{}'; script-src 'sha256-{}'; "
        "base-uri 'none'; form-action 'none'"
    ).format(*hashes)
    template = _environment().get_template("page.html")
    return str(template.render(page=page, style=style, script=script, policy=policy, version=VERSION))


def _refuse_foreign(target: Path) -> None:
    """Raise OutputError for a file that is no report of ours."""
    title = b""
    with suppress(OSError), target.open("rb") as opened:
        title = next((line for line in opened if b"</title>" in line), b"")
    if target.is_symlink() or not title.rstrip().endswith("· scan2albedo</title>".encode()):
        raise OutputError(
            f"{target.parent}: holds {target.name}, which no run of scan2albedo report wrote; "
            "move it away, or give -o with another name"
        )


def data_json(value: Any) -> str:
    """Return JSON that may stand inside a script element: no text in it can end the element.

    >>> print(data_json({"name": "</script>"}))
    {"name":"\\u003c/script\\u003e"}
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


@cache
def _environment() -> Environment:
    with needs_extra("report"):
        from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
        from markupsafe import Markup
    environment = Environment(
        loader=PackageLoader("scan2albedo.report.html", "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Data has been escaped for its place, and the package's own files need no escape.
    environment.filters["data_json"] = lambda value: Markup(data_json(value))
    environment.filters["raw"] = lambda text: Markup(text)
    return environment


@cache
def _static(name: str) -> str:
    return (files("scan2albedo.report.html") / "static" / name).read_text(encoding="utf-8")
