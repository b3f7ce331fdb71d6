"""Files appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from scan2albedo.errors import OutputError


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; rename it to `path` when the block ends well.

    The temporary name keeps the extension (libraries choose the format by it) and the folder (a rename
    is atomic only within a file system). Whatever interrupts the block, the temporary file is removed
    and an older `path` stays as it was.

    Parameters
    ----------
    path : str or Path
        Of the file that is to be written.

    Raises
    ------
    OutputError
        When the folder cannot be written: missing, read-only, or full.

    Examples
    --------
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
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def make_folder(path: str | Path) -> Path:
    """Create a folder with its parents unless it exists, and return it.

    Raises
    ------
    OutputError
        When it cannot be created; the message names the folder and the cause.
    """
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
