"""Hidden names under which files are made, and their removal when the process that made them was killed."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import secrets
import shutil
import time
from contextlib import suppress
from pathlib import Path

_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:6]
_PATTERN = re.compile(r"\..*-([0-9a-f]{6})-(\d+)-[0-9a-f]{8}\.part(\.[^.]*)?")
_LONGEST_STEM = 150
_CLOCK_S = 2.0
_AT_WORK_ELSEWHERE_S = 3600.0
"""A file of another machine's process is left alone for so long: writing takes seconds."""
_unfinished: set[Path] = set()


def hidden_path(target: Path, suffix: str = "") -> Path:
    """Return a new hidden path beside `target`, which tells which process makes it.

    It counts as unfinished until `finished` is called.
    """
    stem = target.name.removesuffix(suffix) if suffix else target.name
    stem = os.fsdecode(os.fsencode(stem)[:_LONGEST_STEM])
    path = target.with_name(f".{stem}-{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.part{suffix}")
    _unfinished.add(path)
    return path


def finished(path: Path) -> None:
    """Remove what is left under a path of `hidden_path`: nothing, unless the work was interrupted."""
    _remove(path)
    _unfinished.discard(path)


def is_hidden_path(path: Path) -> bool:
    """Return whether a path is one of `hidden_path`, of any process."""
    return _PATTERN.fullmatch(path.name) is not None


def remove_unfinished() -> None:
    """Remove all that this process has under hidden paths, for an exit that unwinds nothing."""
    for path in list(_unfinished):
        finished(path)


def remove_leftovers(*folders: Path) -> int:
    """Remove what killed processes left under hidden paths in folders; return how many.

    What processes still work on stays: those of this machine that run, those of others for an hour.
    """
    removed = 0
    for folder in folders:
        with suppress(OSError):
            for entry in os.scandir(folder):
                found = _PATTERN.fullmatch(entry.name)
                if found and not entry.is_symlink() and not _at_work(entry, found[1], int(found[2])):
                    _remove(Path(entry.path))
                    removed += 1
    return removed


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _at_work(entry: os.DirEntry[str], host: str, number: int) -> bool:
    """Return whether the process of a number may still work on an entry."""
    changed = entry.stat(follow_symlinks=False).st_mtime
    if host != _HOST:
        return time.time() - changed < _AT_WORK_ELSEWHERE_S
    try:
        import psutil
    except ImportError:  # of the extra `batch`
        return os.name != "posix" or _answers(number)
    try:
        # A later process may have the same number.
        return bool(psutil.Process(number).create_time() < changed + _CLOCK_S)
    except psutil.Error:
        return False


def _answers(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
