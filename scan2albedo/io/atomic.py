"""Files appear whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile

from scan2albedo.errors import OutputError, one_line
from scan2albedo.io.leftovers import finished, hidden_path


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; rename it to `path` when the block ends well.

    The temporary name keeps the extension (libraries choose the format by it) and the folder (a rename is
    atomic only within a file system). Whatever interrupts the block, the temporary file is removed and an
    older `path` stays as it was. Raises OutputError when the folder is missing, read-only or full.
    """
    target = Path(path)
    temporary = hidden_path(target, target.suffix)
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        said = f"cannot write {target.name} into the folder {target.parent}: {one_line(error)}"
        advice = "check that the folder exists, can be written and has space left, or choose another"
        raise OutputError(f"{said}; {advice}") from error
    finally:
        finished(temporary)


def make_folder(path: str | Path) -> Path:
    """Create a folder with its parents unless it exists, and return it. Raises OutputError with the cause."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot create the folder {folder}: {one_line(error)}; choose another") from error
    return folder


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a whole file atomically; raises `OutputError` like `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | Path, text: str) -> None:
    """Write a whole UTF-8 text file atomically; raises `OutputError` like `atomic_path`."""
    write_bytes(path, text.encode("utf-8"))


@contextmanager
def cannot_write(out: Path) -> Iterator[None]:
    """Turn an OSError of the block, also behind an OutputError, into one that names `out` and the cause."""
    try:
        yield
    except (OSError, OutputError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if cause is None:
            raise
        said = f"cannot write the results into {out}: {one_line(cause)}"
        advice = "check that the folder can be written and has space left, or choose another"
        raise OutputError(f"{said}; {advice}") from error


def check_writable(out: Path) -> None:
    """Prove that a file can be written in `out`, made if missing. Raises OutputError with the cause."""
    make_folder(out)
    try:
        TemporaryFile(dir=out).close()
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
