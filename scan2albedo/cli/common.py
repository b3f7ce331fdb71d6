"""What the commands share: exit statuses, flags, one line an error, a clean end on Ctrl-C and SIGTERM."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from scan2albedo.core import Budget
from scan2albedo.core.raw_scan import scan_name
from scan2albedo.errors import printable
from scan2albedo.io.leftovers import remove_unfinished

if TYPE_CHECKING:
    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.io.run_folder import OwnFiles

SOME_FAILED = 1
"""Exit status where part of the work failed; 128 and the signal's number where one ended the process."""
USAGE_ERROR = 2
"""Exit status where a command cannot do what it is asked."""

JsonOption = Annotated[bool, typer.Option("--json", help="Print a machine-readable summary on stdout.")]
OutFolder = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")]
BudgetOption = Annotated[float | None, typer.Option(help="Seconds that the work may take.")]


_UsageError: Any = typer.BadParameter.__base__
"""Of unknown options, missing arguments and the like: typer exports this kind of it alone."""


class PrintableUsage(TyperGroup):
    """Commands whose usage errors hold names of files only as `printable` has them."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except _UsageError as error:
            text = printable(error.format_message())
            error.format_message = lambda: text
            raise


def say(line: str) -> None:
    """Print one line on stderr, without anything in it that a terminal would obey."""
    typer.echo(printable(line), err=True)


def echo_json(value: Any) -> None:
    """Print strict JSON on stdout: infinite and unknown numbers are null."""
    from scan2albedo.io.records import plain_json

    typer.echo(json.dumps(plain_json(value), indent=2, allow_nan=False).replace("\x7f", "\\u007f"))


def checked_budget(budget: float | None, unit: str = "auto") -> Budget:
    """Return the budget; refuse one, or a unit, that no library call takes."""
    from scan2albedo.io.units import check_unit

    try:
        check_unit(unit)
        return Budget.of(budget)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def refuse_shared_folders(scans: Sequence[Path]) -> None:
    """Refuse scans whose results would overwrite each other: the folder of a result has the scan's name."""
    first: dict[str, Path] = {}
    for path in scans:
        name = scan_name(path)
        other = first.setdefault(name.casefold(), path)
        if other is not path:
            raise typer.BadParameter(
                f"{other} and {path} would both be written to the folder {name}; "
                "rename one, or process them into different folders"
            )


@contextmanager
def working(name: str, out: Path | None, files: OwnFiles[Any] | None = None) -> Iterator[ProgressLines]:
    """Give progress lines for work that writes into `out`, and end it cleanly on Ctrl-C and SIGTERM.

    An `out` that is new and stays empty goes again. With `files` it must be writable, and hold no others of
    their names.
    """
    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.io.atomic import check_writable, removed_if_empty
    from scan2albedo.io.run_folder import RunFolder

    stop_cleanly_on_interrupt(out)
    with removed_if_empty(out), ProgressLines(name) as progress:
        if out is not None and files is not None:
            RunFolder(out, files).check()
            check_writable(out)
        yield progress


def interrupts_raise() -> None:
    """Make Ctrl-C and SIGTERM raise KeyboardInterrupt with the number of the signal."""

    def stop(signum: int, frame: object) -> None:
        raise KeyboardInterrupt(signum)

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)


def stop_cleanly_on_interrupt(out: Path | None) -> None:
    """Make Ctrl-C and SIGTERM remove half-written files, also an empty `out` that is new, and end at once.

    KeyboardInterrupt would unwind through compilers and ray tracers in any state; numba has crashed on that.
    """
    there = out is None or out.exists()

    def stop(signum: int, frame: object) -> None:
        try:
            remove_unfinished()
            if out is not None and not there:
                with suppress(OSError):  # it holds something, or was not made yet
                    out.rmdir()
            # Erases the bar, and shows the cursor.
            tidy = "\r\x1b[2K\x1b[?25h" if sys.stderr.isatty() else ""
            what = "terminated" if signum == signal.SIGTERM else "interrupted"
            complaint = f"{tidy}scan2albedo: {what}; nothing half-written was left behind\n"
            # Not by `print`: `sys.stderr` refuses a second write when the signal came during one.
            os.write(sys.stderr.fileno(), complaint.encode())
        finally:
            os._exit(128 + signum)

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
