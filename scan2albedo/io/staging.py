"""Hidden folders in which a result grows until it is whole."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scan2albedo.errors import OutputError


@contextmanager
def staging_folder(out: Path, name: str) -> Iterator[Path]:
    """Give a hidden folder in `out` that is gone, whatever happens, when the block ends.

    Raises
    ------
    OSError
        When it cannot be created.
    """
    staging = Path(tempfile.mkdtemp(prefix=f".{name}-{os.getpid()}-", suffix=".part", dir=out))
    try:
        yield staging
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def publish(source: Path, target: Path, record: str | None = None) -> None:
    """Rename the files of a folder into another, over older ones of the same names.

    The older `record` goes first and the new one comes last: a folder that has one is whole.
    """
    if record is not None:
        (target / record).unlink(missing_ok=True)
    files = [path for path in source.iterdir() if path.is_file()]
    for path in sorted(files, key=lambda p: p.name == record):
        os.replace(path, target / path.name)


@contextmanager
def gone_if_empty(out: Path | None) -> Iterator[None]:
    """Remove the folder `out` again when the block made it and leaves nothing in it."""
    there = out is None or out.exists()
    try:
        yield
    finally:
        if out is not None and not there:
            with suppress(OSError):  # it holds something
                out.rmdir()


@contextmanager
def telling_where(out: Path) -> Iterator[None]:
    """Turn what fails while results are written in the block into an OutputError that names their folder."""
    try:
        yield
    except (OSError, OutputError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        reason = getattr(cause, "strerror", None) or str(error)
        raise OutputError(
            f"cannot write the results into {out}: {reason}; check that the folder can be written, or choose "
            "another"
        ) from error


def remove_unfinished(out: Path) -> None:
    """Remove the staging folders that this process has in `out`, for an exit that unwinds nothing."""
    for staging in out.glob(f".*-{os.getpid()}-*.part"):
        shutil.rmtree(staging, ignore_errors=True)
