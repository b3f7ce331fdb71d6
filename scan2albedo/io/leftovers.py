"""Hidden paths that name the process working under them; what killed processes left there is removed."""

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
_unfinished: set[Path] = set()


def hidden_path(target: Path, suffix: str = "") -> Path:
    """Return a new hidden path beside `target` that names its process; unfinished until `finished`."""
    stem = target.name.removesuffix(suffix) if suffix else target.name
    stem = os.fsdecode(os.fsencode(stem)[:150])
    path = target.with_name(f".{stem}-{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.part{suffix}")
    _unfinished.add(path)
    return path


def finished(path: Path) -> None:
    """Remove what is left under a path of `hidden_path`: nothing, unless the work was interrupted."""
    remove(path)
    _unfinished.discard(path)


def is_hidden_path(path: Path) -> bool:
    """Return whether a path is one of `hidden_path`, of any process."""
    return _PATTERN.fullmatch(path.name) is not None


def remove_unfinished() -> None:
    """Remove all that this process has under hidden paths, for an exit that unwinds nothing."""
    for path in list(_unfinished):
        finished(path)


def remove_leftovers(*folders: Path) -> int:
    """Remove what killed processes left under hidden paths in folders that are no links; return how many."""
    removed = 0
    for folder in folders:
        if folder.is_symlink():
            continue
        with suppress(OSError):
            for path in folder.iterdir():
                if is_hidden_path(path) and not path.is_symlink() and not at_work(path):
                    remove(path)
                    removed += 1
    return removed


def remove(path: Path) -> None:
    """Remove a file, or a folder with all in it, as far as that is possible; a link to a folder stays."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def at_work(path: Path) -> bool:
    """Return whether the process that made a hidden path may still work on it; elsewhere for an hour."""
    found = _PATTERN.fullmatch(path.name)
    assert found is not None
    host, number = found[1], int(found[2])
    if host != _HOST:
        return time.time() - path.stat(follow_symlinks=False).st_mtime < 3600
    if number == os.getpid():  # or an earlier process of the same number, as in a container
        return path in _unfinished
    try:
        if os.name == "posix":
            os.kill(number, 0)
    except (PermissionError, OverflowError):
        pass
    except ProcessLookupError:
        return False
    return True
