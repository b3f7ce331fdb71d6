"""`write_report`: one HTML file that shows what happened to a scan, or to a batch."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from scan2albedo.errors import OutputError, Scan2AlbedoError, one_line
from scan2albedo.io.atomic import write_text
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import ResultRecord
from scan2albedo.report.html.batch_section import batch_section
from scan2albedo.report.html.encoding import Topologies
from scan2albedo.report.html.page import Page, page_html
from scan2albedo.report.html.rows import (
    CATALOGUE_FILE,
    DONE,
    FAILED,
    RESULT_FILE,
    ScanRow,
    result_folders,
    rows_of_catalogue,
    rows_of_folders,
    selected_rows,
)
from scan2albedo.report.html.scan_section import ONE_OF_MANY, SINGLE, ScanSection, scan_section

REPORT_FILE = "report.html"
MOST_ROWS = 10_000
"""Scans in the table of a batch at most: browsers become slow beyond."""


@dataclass(frozen=True)
class ReportOptions:
    """Settings of `write_report`; ValueError for a number out of range."""

    scans: int = 40
    """How many scans of a batch get a section of their own."""

    def __post_init__(self) -> None:
        if self.scans < 0:
            raise ValueError(f"scans is {self.scans}, expected 0 or more")


@dataclass(frozen=True)
class WrittenReport:
    """Where a report is, and what it holds."""

    path: Path
    """Of the page."""
    scans: int
    """In the table, or 1."""
    done: int
    """Of them."""
    failed: int
    """Of them."""
    sections: int
    """Scans that have a section of their own."""
    size_bytes: int
    """Of the page."""


def write_report(
    out: str | Path,
    path: str | Path | None = None,
    *,
    options: ReportOptions = ReportOptions(),
    on_progress: Callable[[str], None] | None = None,
) -> WrittenReport:
    """Return what a self-contained HTML report of processed scans holds, which is written atomically.

    Parameters
    ----------
    out : path
        Folder of one processed scan (with result.json), of several such folders, or of a batch (with
        catalogue.parquet).
    path : path, optional
        The page; ``out/report.html`` when omitted. Links to files are relative to it.
    options : ReportOptions
    on_progress : callable, optional
        Called with a line for each scan that is put into the page.

    Raises
    ------
    Scan2AlbedoError
        When the folder holds no result, or that of a single scan cannot be read; the message names the file.
    OutputError
        When the page cannot be written, or ``out/report.html`` is no such page.
    """
    folder = Path(out)
    target = folder / REPORT_FILE if path is None else Path(path)
    if not folder.is_dir():
        raise Scan2AlbedoError(f"{folder}: no such folder; give OUT of process or batch, or OUT/<scan name>")
    if path is None and os.path.lexists(target):
        own = False
        with suppress(OSError), target.open("rb") as page:
            title = next((line for line in page if b"</title>" in line), b"")
            own = not target.is_symlink() and title.rstrip().endswith("· scan2albedo</title>".encode())
        if not own:
            raise OutputError(
                f"{folder}: holds {REPORT_FILE}, which no run of scan2albedo report wrote; move it away, or "
                "give -o with another name"
            )
    say = on_progress or (lambda line: None)
    if (folder / CATALOGUE_FILE).is_file():
        return _write_batch(folder, rows_of_catalogue(folder / CATALOGUE_FILE), target, options, say)
    if (folder / RESULT_FILE).is_file():
        return _write_single(folder, target)
    folders = result_folders(folder)
    if not folders:
        raise Scan2AlbedoError(
            f"{folder}: holds no {RESULT_FILE}, no folder with one and no {CATALOGUE_FILE}; "
            "process scans into it first"
        )
    return _write_batch(folder, rows_of_folders(folders), target, options, say)


def _write_single(folder: Path, target: Path) -> WrittenReport:
    record, topologies = read_record(folder / RESULT_FILE, ResultRecord), Topologies()
    section = scan_section(folder, record, target, topologies, SINGLE, anchor="scan", name=record.name)
    page = Page(record.name, _now(), [section], topologies.of_key)
    return _write_page(page, target, scans=1, done=1, failed=0)


def _write_batch(
    folder: Path, rows: Sequence[ScanRow], target: Path, options: ReportOptions, say: Callable[[str], None]
) -> WrittenReport:
    selection, topologies = selected_rows(rows, options.scans), Topologies()
    sections: list[ScanSection] = []
    anchors: dict[int, str] = {}
    not_shown: list[tuple[str, str]] = []
    for k in selection.rows:
        where = rows[k].folder
        assert where is not None
        say(f"{rows[k].name}: {len(sections) + 1} of {len(selection.rows)}")
        anchor = f"scan-{k + 1}"
        try:
            record = read_record(where / RESULT_FILE, ResultRecord)
            section = scan_section(
                where, record, target, topologies, ONE_OF_MANY, anchor=anchor, name=rows[k].name
            )
        except Scan2AlbedoError as error:
            not_shown.append((rows[k].name, one_line(error)))
            continue
        anchors[k] = anchor
        sections.append(section)
    batch = batch_section(rows, anchors, target, MOST_ROWS)
    title = folder.resolve().name or str(folder)
    page = Page(title, _now(), sections, topologies.of_key, batch, selection.reason, not_shown)
    done, failed = (sum(row.status == status for row in rows) for status in (DONE, FAILED))
    return _write_page(page, target, scans=len(rows), done=done, failed=failed)


def _write_page(page: Page, target: Path, *, scans: int, done: int, failed: int) -> WrittenReport:
    text = page_html(page)
    write_text(target, text)
    return WrittenReport(target, scans, done, failed, len(page.scans), len(text.encode()))


def _now() -> str:
    return datetime.now().astimezone().isoformat(" ", "minutes")
