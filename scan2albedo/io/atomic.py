"""Files and result folders appear whole or not at all."""

import ctypes
import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile

from scan2albedo.errors import OutputError, one_line
from scan2albedo.io import leftovers
from scan2albedo.io.leftovers import JOURNAL, finished, folder_lock, hidden_path


@contextmanager
def staged(target: Path, home: Path | None = None) -> Iterator[Path]:
    """Give a new hidden folder to make the files of `target` in, removed when the block ends.

    It is in `home`, beside `target` when omitted, so that `publish` can exchange both; else in `target`.
    """
    home = target.parent if home is None else home
    with suppress(FileExistsError):
        home.mkdir(parents=True)
    leftovers.remove_leftovers(home, target)
    staging, there = hidden_path(home / target.name), target.is_dir()
    try:
        if there and target.stat().st_dev != home.stat().st_dev:
            raise PermissionError
        staging.mkdir()
    except OSError:
        finished(staging)
        if not there:
            raise
        staging = hidden_path(target / target.name)
        staging.mkdir()
    try:
        yield staging
    finally:
        finished(staging)


def publish(staging: Path, target: Path, dropped: Collection[str], last: Collection[str] = ()) -> None:
    """Put the files of the folder `staging` into the folder `target`, all or none.

    Files in `target` of the same names are replaced, those named in `dropped`, by paths in `target`, go, and
    all others stay. A copy of the folder is completed under its hidden name, with hard links to the files of
    others, and exchanged with it in one step. Where that is impossible (a mount point, a parent that cannot
    be written, a file system without exchange or links, the current folder), files are renamed one by one
    under `JOURNAL`, those named in `last` at the end. The caller holds `folder_lock(target)`. Raises OSError,
    and OutputError for a link or a file in the place of a folder, with `target` as it was.
    """
    made = sorted(_moves(staging, target), key=lambda name: name in last)
    with signals_held():
        if not os.path.lexists(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(staging, target)
            return
        if not os.access(target, os.W_OK | os.X_OK):
            raise PermissionError(None, f"the folder {target} cannot be written")
        if _exchanged(staging, target, dropped):
            return
        # Files are renamed one by one.
        holder = hidden_path(target / target.name)
        try:
            holder.mkdir(mode=0o700)
            new, old = holder / "new", holder / "old"
            try:
                os.rename(staging, new)
            except OSError:  # a mount point
                shutil.copytree(staging, new, symlinks=True)
            older = [name for name in {*made, *dropped} if os.path.lexists(target / name)]
            for name in older:
                (old / name).parent.mkdir(parents=True, exist_ok=True)
            journal = {"holder": holder.name, "made": made, "dropped": older}
            (holder / JOURNAL).write_text(json.dumps(journal), encoding="utf-8")
            leftovers.keep(holder)  # from here on it holds what is not to be lost
            os.rename(holder / JOURNAL, target / JOURNAL)
            for name in older:
                os.rename(target / name, old / name)
            for name in made:
                os.rename(new / name, target / name)
            os.unlink(target / JOURNAL)
        except BaseException:  # whatever stops it, an interrupt too: the folder is whole again
            leftovers.roll_back(target, locked=True)
            raise
        finally:
            if not os.path.lexists(target / JOURNAL):
                finished(holder)


def _moves(source: Path, target: Path, prefix: str = "") -> list[str]:
    """Return what is renamed from `source` into `target`: files, and folders that are not there yet."""
    moves: list[str] = []
    for path in sorted(source.iterdir()):
        place = target / path.name
        if path.is_dir() and place.is_symlink():
            raise OutputError(f"{place} is a link to another folder, and links are not followed; remove it")
        if os.path.lexists(place) and path.is_dir() != place.is_dir() and not place.is_symlink():
            raise OutputError(f"{place} is in the way: a file and a folder of one name; remove it")
        if path.is_dir() and place.is_dir():
            moves += _moves(path, place, f"{prefix}{path.name}/")
        else:
            moves.append(f"{prefix}{path.name}")
    return moves


def _exchanged(staging: Path, target: Path, dropped: Collection[str]) -> bool:
    """Complete `staging` and exchange it with `target`; False where that cannot be done here."""
    linked: dict[str, int] = {}
    try:
        here = Path(os.getcwd())
        if staging.parent != target.parent or target in (here, *here.parents):
            return False
        _link_others(target, staging, dropped, linked)
        _exchange(staging, target)
    except OSError:
        return False
    # What somebody put into the old folder since it was read goes to the new one.
    for root, _, files in os.walk(staging):
        for file in files:
            old = Path(root, file)
            name = old.relative_to(staging).as_posix()
            new = target / name
            added = name not in linked and name not in dropped and not os.path.lexists(new)
            with suppress(OSError):
                if added or linked.get(name, old.lstat().st_ino) != old.lstat().st_ino:
                    new.parent.mkdir(parents=True, exist_ok=True)
                    os.rename(old, new)
    return True


def _link_others(
    old: Path, new: Path, dropped: Collection[str], linked: dict[str, int], prefix: str = ""
) -> None:
    for path in old.iterdir():
        name, place = prefix + path.name, new / path.name
        if path.is_dir() and not path.is_symlink():
            if not os.access(path, os.W_OK | os.X_OK):
                raise PermissionError(None, f"{path} cannot be removed")
            place.mkdir(exist_ok=True)
            _link_others(path, place, dropped, linked, f"{name}/")
        elif name not in dropped and not os.path.lexists(place):
            if path.is_symlink():
                os.symlink(os.readlink(path), place)
            else:
                os.link(path, place)
            linked[name] = path.lstat().st_ino
    there, made = old.stat(), new.stat()
    if (there.st_uid, there.st_gid) != (made.st_uid, made.st_gid):
        os.chown(new, there.st_uid, there.st_gid)
    shutil.copystat(old, new)
    os.utime(new)


def _exchange(a: Path, b: Path) -> None:
    """Exchange two paths in one step. Raises OSError where the system or file system cannot."""
    name = "renamex_np" if sys.platform == "darwin" else "renameat2"
    exchange = getattr(ctypes.CDLL(None, use_errno=True), name, None) if os.name == "posix" else None
    if exchange is None:
        raise OSError(None, "this system exchanges no paths")
    here = () if sys.platform == "darwin" else (-100,)  # AT_FDCWD
    # 2 is RENAME_SWAP of macOS and RENAME_EXCHANGE of Linux.
    if exchange(*here, os.fsencode(a), *here, os.fsencode(b), 2):
        raise OSError(ctypes.get_errno(), "paths cannot be exchanged")


@contextmanager
def signals_held() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM wait until the block has ended."""
    came: list[int] = []
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not None:  # else not set from Python, and not to be restored
                before[number] = signal.signal(number, lambda which, frame: came.append(which))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


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
def result_folder(
    out: Path, *records: str, obsolete: Collection[str] = (), staged_in: Path | None = None
) -> Iterator[Path]:
    """Give a hidden folder whose files, also those in its folders, go to `out` when the block ends well.

    Whatever ends the block or the process, `out` is as it was or has all new files, see `publish`. Files of
    the same names are replaced, whoever made them, and those named in `obsolete` removed: a `RunFolder` knows
    whose they are. The hidden folder is made in `staged_in`, beside `out` when omitted. `records` come last
    where files are renamed one by one. Raises OutputError, naming `out` and the cause, when it cannot be
    written, or a folder in it is a link.
    """
    target = Path(os.path.realpath(out))
    with cannot_write(out), staged(target, staged_in and Path(os.path.realpath(staged_in))) as staging:
        yield staging
        with folder_lock(target):
            # A record may have been edited: nothing outside `out` is touched.
            publish(staging, target, {name for name in obsolete if Path(name).name == name}, records)


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
