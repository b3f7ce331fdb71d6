"""What the commands share: exit statuses, options, one line an error, a clean end on Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from scan2albedo.io.atomic import remove_unfinished

DONE, SOME_FAILED, USAGE_ERROR, INTERRUPTED = 0, 1, 2, 130

JsonOption = Annotated[bool, typer.Option("--json", help="Print a machine-readable summary on stdout.")]


def echo_json(value: Any) -> None:
    """Print strict JSON on stdout: what is infinite or unknown is null."""
    from scan2albedo.io.records import plain_json

    typer.echo(json.dumps(plain_json(value), indent=2, allow_nan=False))


def refuse_shared_folders(scans: list[Path]) -> None:
    """Refuse scans whose results would overwrite each other: the folder of a result has the scan's name."""
    first: dict[str, Path] = {}
    for path in scans:
        other = first.setdefault(path.stem.casefold(), path)
        if other is not path:
            raise typer.BadParameter(
                f"{other} and {path} would both be written to the folder {path.stem}; "
                "rename one, or process them into different folders"
            )


def one_line(error: BaseException | str) -> str:
    """Return a message, or that of an error, on one line."""
    return " ".join(str(error).split())


def stop_cleanly_on_interrupt(out: Path | None) -> None:
    """Make Ctrl-C remove what is half-written in `out`, say so, and end the process at once.

    Raising KeyboardInterrupt instead would unwind through compilers and ray tracers in whatever state
    they are in; numba has crashed on that.
    """

    there = out is None or out.exists()

    def stop(signum: int, frame: object) -> None:
        if out is not None:
            remove_unfinished(out)
            if not there:
                with suppress(OSError):  # it holds something, or was not made yet
                    out.rmdir()
        show_cursor = "\x1b[?25h" if sys.stderr.isatty() else ""
        complaint = f"{show_cursor}scan2albedo: interrupted; nothing half-written was left behind"
        print(complaint, file=sys.stderr, flush=True)
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, stop)
