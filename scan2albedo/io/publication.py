"""Folders of results appear whole or not at all, also where a process is killed between two renames.

Files that replace others are first renamed, all at once, into the folder `PENDING` of the target, and from
there one by one to their places. Of a target that was left so, a reader says so and changes nothing; only who
writes into it ends what was begun, and trusts neither that folder nor links: it may have come from anywhere.
"""

import json
import os
import signal
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scan2albedo.errors import OutputError
from scan2albedo.io import leftovers
from scan2albedo.io.atomic import cannot_write
from scan2albedo.io.leftovers import finished, hidden_path

PENDING = ".publishing"
"""Folder of the new files that are not yet in their places in the folder above."""
_DROPPED = ".dropped.json"
"""List in `PENDING` of the files of earlier runs that go."""
_LIST_BYTES = 1 << 20
"""Longest such list that is read, in bytes: ten thousand names of a hundred characters."""


@contextmanager
def staged(target: Path, home: Path | None = None) -> Iterator[Path]:
    """Give a new hidden folder to make the files of `target` in, removed when the block ends.

    It is in `target` where there is one, else in `home`, beside `target` when omitted.
    """
    home = target.parent if home is None else home
    with suppress(FileExistsError):
        home.mkdir(parents=True)
    leftovers.remove_leftovers(home, target)
    staging = hidden_path((target if target.is_dir() else home) / target.name)
    try:
        staging.mkdir()
        yield staging
    finally:
        finished(staging)


def publish(staging: Path, target: Path, dropped: Collection[str] = ()) -> None:
    """Put the files of the folder `staging` into the folder `target`, all or none.

    Where there is no `target` yet, one rename makes it. Else its files of the same names are replaced, those
    named in `dropped`, by paths in it, go, and others stay: once `PENDING` is there, whatever stops the
    renames, the next writer goes on with them. The caller holds `folder_lock(target)`. Raises OSError, and
    OutputError for a link or a file in the place of a folder, with `target` as it was.
    """
    made = _files(staging, target)
    with signals_held():
        if not os.path.lexists(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(staging, target)
            return
        gone = sorted({*dropped} - {*made})
        (staging / _DROPPED).write_text(json.dumps(gone), encoding="utf-8")
        os.rename(staging, target / PENDING)
        try:
            _move(target, made, gone)
        except BaseException:  # whatever stopped it, an interrupt too
            _move(target, made, gone)
            raise


def _files(source: Path, target: Path) -> list[str]:
    """Return the paths of all files in `source`; OutputError for what is in their way in `target`."""
    files: list[str] = []
    for path in sorted(source.rglob("*")):
        name = path.relative_to(source).as_posix()
        place = target / name
        if path.is_dir() and place.is_symlink():
            raise OutputError(f"{place} is a link to another folder, and links are not followed; remove it")
        if os.path.lexists(place) and path.is_dir() != place.is_dir() and not place.is_symlink():
            raise OutputError(f"{place} is in the way: a file and a folder of one name; remove it")
        if not path.is_dir() and name != _DROPPED:
            files.append(name)
    return files


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
def folder_lock(folder: Path) -> Iterator[None]:
    """Keep other publishers out of a folder by a lock on its parent, where there are locks."""
    descriptor = None
    try:
        # Not POSIX, a folder that cannot be read, or a file system without locks: then there is none.
        with suppress(ImportError, OSError):
            import fcntl

            descriptor = os.open(folder.parent, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        if descriptor is not None:
            with suppress(OSError):  # processes that were forked meanwhile hold the descriptor too
                fcntl.flock(descriptor, fcntl.LOCK_UN)
            os.close(descriptor)


def check_whole(folder: Path) -> None:
    """Raise OSError for a folder whose publication was cut off; wait for one that lasts. Writes nothing."""
    if os.path.lexists(folder / PENDING):
        with folder_lock(Path(os.path.realpath(folder))):
            if os.path.lexists(folder / PENDING):
                said = f"a run was ended while it wrote the files there, see {PENDING}"
                raise OSError(None, f"{said}; run it again into that folder")


def settle(folder: Path, ours: Callable[[str], bool]) -> None:
    """End a publication into a folder that was cut off, see `go_on`, before writing into it."""
    if os.path.lexists(folder / PENDING):
        folder = Path(os.path.realpath(folder))
        with folder_lock(folder):
            go_on(folder, ours)


def go_on(folder: Path, ours: Callable[[str], bool]) -> None:
    """End a publication that was cut off, if one was; the caller holds the lock, where there is one.

    `ours` tells of a path in the folder whether we write such a file. Raises OSError, with nothing moved,
    where `PENDING` is of another user, or holds other files or a link.
    """
    pending = folder / PENDING
    if not os.path.lexists(pending):
        return
    try:
        for path in (pending, *pending.rglob("*")):
            if path.is_symlink() or not (path.is_dir() or path.is_file()):
                raise ValueError("a link, or no file")
        if hasattr(os, "geteuid") and pending.stat().st_uid != os.geteuid():
            raise ValueError("no folder of this user")
        made = _files(pending, folder)
        gone: list[str] = []
        with suppress(FileNotFoundError), (pending / _DROPPED).open("rb") as file:
            gone = json.loads(file.read(_LIST_BYTES))
        for name in (*made, *gone):
            if not ours(name) or {"", ".", ".."} & {*name.split("/")} or (folder / name).parent.is_symlink():
                raise ValueError("another name")
    except (ValueError, TypeError, AttributeError, RecursionError, OSError, OutputError) as error:
        said = f"{pending} was edited or cut short, or is not ours; remove it"
        raise OSError(None, said) from error
    _move(folder, made, gone)


def _move(folder: Path, made: Iterable[str], gone: Iterable[str]) -> None:
    """Remove the files `gone`, rename those `made` out of `PENDING`; this can be killed, and repeated."""
    pending = folder / PENDING
    for name in gone:
        if not (folder / name).is_dir():
            (folder / name).unlink(missing_ok=True)
    for name in made:
        (folder / name).parent.mkdir(exist_ok=True)
        with suppress(FileNotFoundError):
            os.replace(pending / name, folder / name)
    emptied = hidden_path(folder / folder.name)
    os.rename(pending, emptied)
    finished(emptied)


@contextmanager
def result_folder(out: Path, staged_in: Path | None = None) -> Iterator[Path]:
    """Give a hidden folder whose files, also those in its folders, go to `out` when the block ends well.

    Whatever ends the block or the process, `out` is as it was or has all new files, see `publish`. Files of
    the same names are replaced, whoever made them: a `RunFolder` knows whose they are. Of an `out` that is
    new the hidden folder is made in `staged_in`, beside `out` when omitted. Raises OutputError, naming `out`
    and the cause, when it cannot be written, or a folder in it is a link.
    """
    target = Path(os.path.realpath(out))
    with cannot_write(out), staged(target, staged_in and Path(os.path.realpath(staged_in))) as staging:
        yield staging
        with folder_lock(target):
            go_on(target, set(_files(staging, target)).__contains__)
            publish(staging, target)
