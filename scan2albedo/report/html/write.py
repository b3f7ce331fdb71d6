"""`write_report`: one HTML file that shows what happened to a scan, or to a batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.atomic import write_text
from scan2albedo.io.result_json import ResultRecord, read_record
from scan2albedo.report.html.batch_section import batch_section
from scan2albedo.report.html.catalogue import CATALOGUE_FILE, rows_of_catalogue
from scan2albedo.report.html.mesh_data import Topologies
from scan2albedo.report.html.options import ReportOptions, WrittenReport
from scan2albedo.report.html.page import Page, page_html
from scan2albedo.report.html.rows import DONE, FAILED, RESULT_FILE, ScanRow, result_folders, rows_of_folders
from scan2albedo.report.html.scan_section import ScanSection, SectionStyle, scan_section
from scan2albedo.report.html.selection import selected_rows

REPORT_FILE = "report.html"


def write_report(
    out: str | Path,
    path: str | Path | None = None,
    *,
    options: ReportOptions = ReportOptions(),
    on_progress: Callable[[str], None] | None = None,
) -> WrittenReport:
    """Write a self-contained HTML report of processed scans, atomically.

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

    Returns
    -------
    WrittenReport

    Raises
    ------
    Scan2AlbedoError
        When the folder holds no result, or that of a single scan cannot be read; the message names the file.
    OutputError
        When the page cannot be written.
    """
    folder = Path(out)
    target = folder / REPORT_FILE if path is None else Path(path)
    if not folder.is_dir():
        raise Scan2AlbedoError(f"{folder}: no such folder; give OUT of process or batch, or OUT/<scan name>")
    say = on_progress or (lambda line: None)
    if (folder / CATALOGUE_FILE).is_file():
        return _write_batch(folder, rows_of_catalogue(folder / CATALOGUE_FILE), target, options, say)
    if (folder / RESULT_FILE).is_file():
        return _write_single(folder, target, options)
    folders = result_folders(folder)
    if not folders:
        raise Scan2AlbedoError(
            f"{folder}: holds no {RESULT_FILE}, no folder with one and no {CATALOGUE_FILE}; "
            "process scans into it first"
        )
    return _write_batch(folder, rows_of_folders(folders), target, options, say)


def _write_single(folder: Path, target: Path, options: ReportOptions) -> WrittenReport:
    record, topologies = read_record(folder / RESULT_FILE, ResultRecord), Topologies()
    style = SectionStyle.single(options.texture_size, options.residual)
    section = scan_section(folder, record, target, topologies, style, anchor="scan", name=record.name)
    page = Page(record.name, _now(), [section], topologies.of_key)
    return _finish(page, target, scans=1, done=1, failed=0)


def _write_batch(
    folder: Path, rows: Sequence[ScanRow], target: Path, options: ReportOptions, say: Callable[[str], None]
) -> WrittenReport:
    selection = selected_rows(rows, options.scans)
    style, topologies = SectionStyle.batch(options.batch_texture_size), Topologies()
    sections: list[ScanSection] = []
    anchors: dict[int, str] = {}
    not_shown: list[tuple[str, str]] = []
    for k in selection.rows:
        where = rows[k].folder
        assert where is not None
        say(f"{rows[k].name}: {len(sections) + 1} of {len(selection.rows)}")
        try:
            record = read_record(where / RESULT_FILE, ResultRecord)
        except Scan2AlbedoError as error:
            not_shown.append((rows[k].name, " ".join(str(error).split())))
            continue
        anchors[k] = f"scan-{k + 1}"
        sections.append(
            scan_section(where, record, target, topologies, style, anchor=anchors[k], name=rows[k].name)
        )
    batch = batch_section(rows, anchors, target, options.rows)
    title = folder.resolve().name or str(folder)
    page = Page(title, _now(), sections, topologies.of_key, batch, selection.reason, not_shown)
    done, failed = (sum(row.status == status for row in rows) for status in (DONE, FAILED))
    return _finish(page, target, scans=len(rows), done=done, failed=failed)


def _finish(page: Page, target: Path, *, scans: int, done: int, failed: int) -> WrittenReport:
    text = page_html(page)
    write_text(target, text)
    return WrittenReport(target, scans, done, failed, len(page.scans), len(text.encode()))


def _now() -> str:
    return datetime.now().astimezone().isoformat(" ", "minutes")
