"""Result folders: files are made in a hidden folder and renamed into place, the record last."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scan2albedo.errors import OutputError
from scan2albedo.io.atomic import make_folder


@contextmanager
def result_folder(
    out: Path, *records: str, obsolete: Collection[str] = (), staged_in: Path | None = None
) -> Iterator[Path]:
    """Give a hidden folder whose files, also those in its folders, go to `out` when the block ends well.

    An error or a kill while files are made leaves `out` as it was, without half-files. An older record is
    removed before any other file changes and the new one comes last: a folder that has a record is whole.

    Parameters
    ----------
    out : Path
        Made when it is not there.
    *records : str
        Names of the files that mark a whole folder, such as "result.json".
    obsolete : collection of str
        Names that an older result may have left in `out`; those that the new one has not are removed.
    staged_in : Path, optional
        Where the hidden folder stands, on the file system of `out`; in `out` itself when omitted.

    Raises
    ------
    OutputError
        When `out` cannot be written; names it and the cause.

    Examples
    --------
    >>> out = Path(tempfile.mkdtemp())
    >>> with result_folder(out, "result.json") as folder:
    ...     _ = (folder / "result.json").write_text("{}")
    >>> [path.name for path in out.iterdir()]
    ['result.json']
    """
    try:
        home = make_folder(out if staged_in is None else staged_in)
        staging = Path(tempfile.mkdtemp(prefix=f".{out.name}-{os.getpid()}-", suffix=".part", dir=home))
        try:
            yield staging
            _publish(staging, make_folder(out), records, obsolete)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    except (OSError, OutputError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        reason = getattr(cause, "strerror", None) or str(error)
        raise OutputError(
            f"cannot write the results into {out}: {reason}; check that the folder can be written and has "
            "space left, or choose another"
        ) from error


def _publish(source: Path, target: Path, records: Collection[str], obsolete: Collection[str] = ()) -> None:
    made = {path.name for path in source.iterdir()}
    for name in (*made.intersection(records), *(set(obsolete) - made)):
        if Path(name).name == name:  # a record may have been edited: nothing outside `target` is touched
            (target / name).unlink(missing_ok=True)
    for path in sorted(source.iterdir(), key=lambda path: (path.is_file(), path.name in records)):
        if path.is_dir():
            _publish(path, make_folder(target / path.name), records)
        else:
            os.replace(path, target / path.name)


def remove_unfinished(out: Path) -> None:
    """Remove the hidden folders that this process has in `out`, for an exit that unwinds nothing."""
    for staging in out.glob(f".*-{os.getpid()}-*.part"):
        shutil.rmtree(staging, ignore_errors=True)


def check_writable(out: Path) -> None:
    """Create `out` and prove that a file can be written there.

    Raises
    ------
    OutputError
        Naming the folder and the cause.
    """
    make_folder(out)
    try:
        with tempfile.NamedTemporaryFile(dir=out, prefix=".probe-"):
            pass
    except OSError as error:
        raise OutputError(f"cannot write into {out}: {error.strerror}; choose another folder") from error


@contextmanager
def removed_if_empty(out: Path | None) -> Iterator[None]:
    """Remove the folder `out` again when the block made it and leaves nothing in it."""
    existed = out is None or out.exists()
    try:
        yield
    finally:
        if out is not None and not existed:
            with suppress(OSError):  # it holds something
                out.rmdir()
