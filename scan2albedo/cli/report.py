"""The command `report`: what happened to a scan or a batch, as one HTML page."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from scan2albedo.cli.common import JsonOption, echo_json, say, stop_cleanly_on_interrupt


def report(
    out: Annotated[
        Path,
        typer.Argument(help="What process or batch wrote: OUT, or the folder of one scan.", metavar="OUT"),
    ],
    path: Annotated[
        Path | None, typer.Option("--out", "-o", help="The page; OUT/report.html when omitted.")
    ] = None,
    scans: Annotated[
        int, typer.Option(help="How many scans of a batch are shown in full, the worst first.", min=0)
    ] = 40,
    json_summary: JsonOption = False,
) -> None:
    """Show what happened to a scan or a batch as one HTML page that needs no network."""
    if path is not None and path.suffix.lower() not in (".html", ".htm"):
        raise typer.BadParameter(f"-o takes a name that ends in .html, not {path}")
    from scan2albedo.report.html import write_report
    from scan2albedo.report.html.texts import size_text

    stop_cleanly_on_interrupt(None)
    written = write_report(out, path, scans=scans, on_progress=say)
    say(f"{written.path}: {written.scans} scans, {size_text(written.size_bytes)}")
    if json_summary:
        figures = asdict(written)
        echo_json({"status": "done", "out": str(figures.pop("path")), **figures})
