"""Files and result folders appear whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scan2albedo.errors import OutputError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; rename it to `path` when the block ends well.

    The temporary name keeps the extension (libraries choose the format by it) and the folder (a rename is
    atomic only within a file system). Whatever interrupts the block, the temporary file is removed and an
    older `path` stays as it was. Raises OutputError when the folder is missing, read-only or full.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_path(folder / "a.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    >>> [p.name for p in folder.iterdir()]
    ['a.txt']
    """
    target = Path(path)
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(6)}.part{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        cause = error.strerror or str(error)
        raise OutputError(
            f"cannot write {target.name} into the folder {target.parent}: {cause}; "
            "check that the folder exists, can be written and has space left, or choose another"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def make_folder(path: str | Path) -> Path:
    """Create a folder with its parents unless it exists, and return it. Raises OutputError with the cause."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        cause = error.strerror or str(error)
        raise OutputError(f"cannot create the folder {folder}: {cause}; choose another folder") from error
    return folder


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a whole file atomically; raises `OutputError` like `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | Path, text: str) -> None:
    """Write a whole UTF-8 text file atomically; raises `OutputError` like `atomic_path`."""
    write_bytes(path, text.encode("utf-8"))


@contextmanager
def result_folder(
    out: Path, *records: str, obsolete: Collection[str] = (), staged_in: Path | None = None
) -> Iterator[Path]:
    """Give a hidden folder whose files, also those in its folders, go to `out` when the block ends well.

    An error or a kill while files are made leaves `out` as it was. An older one of the `records`, such as
    "result.json", is removed before any other file changes and the new one comes last: a folder that has a
    record is whole. Files in `out` that are named in `obsolete` and were not made anew are removed. The
    hidden folder is made in `staged_in`, on the file system of `out`; in `out` itself when omitted. Raises
    OutputError, naming `out` and the cause, when it cannot be written.

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
    """Prove that a file can be written in `out`, made if missing. Raises OutputError with the cause."""
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
