"""Files and result folders appear whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scan2albedo.errors import OutputError
from scan2albedo.io.leftovers import finished, hidden_path, remove_leftovers

_CHANGING = ".unfinished.json"
"""Lists the files of a folder while they change."""


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
    temporary = hidden_path(target, target.suffix)
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
        finished(temporary)


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
    record is whole. Files in `out` that are named in `obsolete` and were not made anew are removed. While
    files change, `out` holds a list of them (`unfinished_files`). The hidden folder is made in `staged_in`,
    on the file system of `out`; in `out` itself when omitted; those of killed processes go. Raises
    OutputError, naming `out` and the cause, when it cannot be written, or a folder in it is a link.

    >>> import tempfile
    >>> out = Path(tempfile.mkdtemp())
    >>> with result_folder(out, "result.json") as folder:
    ...     _ = (folder / "result.json").write_text("{}")
    >>> [path.name for path in out.iterdir()]
    ['result.json']
    """
    try:
        home = make_folder(out if staged_in is None else staged_in)
        remove_leftovers(home, out)
        staging = hidden_path(home / out.name)
        try:
            staging.mkdir(mode=0o700)
            yield staging
            _publish(staging, make_folder(out), records, obsolete)
        finally:
            finished(staging)
    except (OSError, OutputError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        reason = getattr(cause, "strerror", None) or str(error)
        raise OutputError(
            f"cannot write the results into {out}: {reason}; check that the folder can be written and has "
            "space left, or choose another"
        ) from error


def _publish(source: Path, target: Path, records: Collection[str], obsolete: Collection[str] = ()) -> None:
    files = sorted(source.iterdir(), key=lambda path: (path.is_file(), path.name in records))
    made = {path.name for path in files}
    # A record may have been edited: nothing outside `target` is touched.
    older = {name for name in obsolete if Path(name).name == name}
    write_text(target / _CHANGING, json.dumps(sorted(made | older)))
    for name in (*made.intersection(records), *(older - made)):
        (target / name).unlink(missing_ok=True)
    for path in files:
        if path.is_dir():
            _publish(path, make_folder(_no_link(target / path.name)), records)
        else:
            os.replace(path, target / path.name)
    (target / _CHANGING).unlink()


def _no_link(folder: Path) -> Path:
    if folder.is_symlink():
        raise OutputError(f"{folder} is a link to another folder, and links are not followed; remove it")
    return folder


def unfinished_files(folder: Path) -> frozenset[str]:
    """Return the names of files that a killed process was putting into a folder, or removing from it."""
    try:
        listed = json.loads((folder / _CHANGING).read_bytes())
    except (OSError, ValueError, RecursionError):
        return frozenset()
    names = listed if isinstance(listed, list) else []
    return frozenset(name for name in names if isinstance(name, str))


def check_writable(out: Path) -> None:
    """Prove that a file can be written in `out`, made if missing. Raises OutputError with the cause."""
    make_folder(out)
    probe = hidden_path(out / "probe")
    try:
        probe.touch(exist_ok=False)
    except OSError as error:
        raise OutputError(f"cannot write into {out}: {error.strerror}; choose another folder") from error
    finally:
        finished(probe)


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
