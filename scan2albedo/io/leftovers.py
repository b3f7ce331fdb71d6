"""What killed processes leave: files under hidden names, and publications that ended between two renames."""

import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

JOURNAL = ".publishing.json"
"""Lists the renames of a publication that cannot be a single one, while they last."""
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
    _remove(path)
    _unfinished.discard(path)


def keep(path: Path) -> None:
    """Let `remove_unfinished` leave a path of `hidden_path` alone."""
    _unfinished.discard(path)


def is_hidden_path(path: Path) -> bool:
    """Return whether a path is one of `hidden_path`, of any process."""
    return _PATTERN.fullmatch(path.name) is not None


def remove_unfinished() -> None:
    """Remove all that this process has under hidden paths, for an exit that unwinds nothing."""
    for path in list(_unfinished):
        finished(path)


def remove_leftovers(*folders: Path) -> int:
    """Remove what killed processes left under hidden paths in folders, settle these; return how many."""
    removed = 0
    for folder in folders:
        with suppress(OSError):
            settle(folder)
            for path in folder.iterdir():
                if is_hidden_path(path) and not path.is_symlink() and not _at_work(path):
                    _remove(path)
                    removed += 1
    return removed


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _at_work(path: Path) -> bool:
    """Return whether the process that made a hidden path may still work on it; elsewhere for an hour."""
    found = _PATTERN.fullmatch(path.name)
    assert found is not None
    host, number = found[1], int(found[2])
    changed = path.stat(follow_symlinks=False).st_mtime
    if host != _HOST:
        return time.time() - changed < 3600
    try:
        import psutil
    except ImportError:  # of the extra `batch`
        try:
            if os.name == "posix":
                os.kill(number, 0)
        except (PermissionError, OverflowError):
            pass
        except ProcessLookupError:
            return False
        return True
    try:
        # A later process may have the same number; clocks differ by up to two seconds.
        return bool(psutil.Process(number).create_time() < changed + 2)
    except psutil.Error:
        return False


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Keep other publishers out of a folder, by a lock on its parent if there is one; `roll_back` first."""
    descriptor, locked = None, False
    try:
        # Not POSIX, a folder that cannot be read, or a file system without locks: then there is none.
        with suppress(ImportError, OSError):
            import fcntl

            descriptor = os.open(folder.parent, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            locked = True
        roll_back(folder, locked)
        yield
    finally:
        if descriptor is not None:
            if locked:  # processes that were forked meanwhile hold the descriptor too
                fcntl.flock(descriptor, fcntl.LOCK_UN)
            os.close(descriptor)


def settle(folder: Path) -> None:
    """Undo a publication into a folder that was killed between two renames; OSError when impossible."""
    if os.path.lexists(folder / JOURNAL):
        with folder_lock(Path(os.path.realpath(folder))):
            pass


def roll_back(folder: Path, locked: bool) -> None:
    """Undo the renames of a folder's `JOURNAL`, if it has one; the caller holds the lock, where there is one.

    The journal names a hidden folder, `holder`. Files in `dropped` were being renamed into old/ in it, then
    files in `made` out of new/ in it. A killed rollback can be repeated.
    """
    try:
        journal = json.loads((folder / JOURNAL).read_bytes())
        holder, made, dropped = folder / journal["holder"], journal["made"], journal["dropped"]
        inside = not any({"", ".", ".."} & {*name.split("/")} for name in (*made, *dropped))
        ours = inside and holder.parent == folder and is_hidden_path(holder) and not holder.is_symlink()
    except FileNotFoundError:
        return
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        ours = False
    if not ours:
        raise OSError(None, f"{folder / JOURNAL} was edited or cut short; remove it")
    if not locked and holder.exists() and _at_work(holder):
        raise OSError(None, "another run writes into it now")
    new, old = holder / "new", holder / "old"
    for name in made:
        if not os.path.lexists(new / name):
            with suppress(FileNotFoundError):  # somebody removed it
                os.rename(folder / name, new / name)
    for name in dropped:
        if os.path.lexists(old / name):
            os.rename(old / name, folder / name)
    os.unlink(folder / JOURNAL)
    _remove(holder)
