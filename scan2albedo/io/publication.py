"""Folders of results appear whole or not at all, also where a process is killed between two renames.

Files that replace others are renamed one by one out of a hidden folder. While that lasts a `JOURNAL` names
them. Of a folder that was left so, a reader says so and changes nothing; only who writes into the folder ends
what the journal began, and trusts neither it nor links: the folder may have come from anywhere.
"""

import json
import os
import signal
import stat
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from scan2albedo.errors import OutputError
from scan2albedo.io import leftovers
from scan2albedo.io.atomic import cannot_write
from scan2albedo.io.leftovers import JOURNAL, at_work, finished, hidden_path, is_hidden_path, remove

JOURNAL_BYTES = 1 << 20
"""Longest journal that is read, in bytes: ten thousand names of a hundred characters."""


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
    named in `dropped`, by paths in it, go, and others stay: once the `JOURNAL` is there, whatever stops the
    renames, the next writer goes on with them. The caller holds `folder_lock(target)`. Raises OSError, and
    OutputError for a link or a file in the place of a folder, with `target` as it was.
    """
    made = _files(staging, target)
    with signals_held():
        if not os.path.lexists(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(staging, target)
            return
        holder = hidden_path(target / target.name)
        try:
            os.rename(staging, holder)
            journal: dict[str, Any] = {
                "holder": holder.name,
                "made": made,
                "dropped": sorted({*dropped} - {*made}),
            }
            (holder / JOURNAL).write_text(json.dumps(journal), encoding="utf-8")
            leftovers.keep(holder)  # from here on it holds what is not to be lost
            os.rename(holder / JOURNAL, target / JOURNAL)
            try:
                _move(target, **journal)
            except BaseException:  # whatever stopped it, an interrupt too
                _move(target, **journal)
                raise
        finally:
            if not os.path.lexists(target / JOURNAL):
                finished(holder)


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
        files += [] if path.is_dir() else [name]
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
def folder_lock(folder: Path) -> Iterator[bool]:
    """Keep other publishers out of a folder by a lock on its parent; give whether there is one."""
    descriptor, locked = None, False
    try:
        # Not POSIX, a folder that cannot be read, or a file system without locks: then there is none.
        with suppress(ImportError, OSError):
            import fcntl

            descriptor = os.open(folder.parent, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            locked = True
        yield locked
    finally:
        if descriptor is not None:
            if locked:  # processes that were forked meanwhile hold the descriptor too
                fcntl.flock(descriptor, fcntl.LOCK_UN)
            os.close(descriptor)


def check_whole(folder: Path) -> None:
    """Raise OSError for a folder whose publication was cut off; wait for one that lasts. Writes nothing."""
    if os.path.lexists(folder / JOURNAL):
        with folder_lock(Path(os.path.realpath(folder))):
            if os.path.lexists(folder / JOURNAL):
                said = f"a run was ended while it wrote the files there, see {JOURNAL}"
                raise OSError(None, f"{said}; run it again into that folder")


def settle(folder: Path, ours: Callable[[str], bool]) -> None:
    """End a publication into a folder that was cut off, see `go_on`, before writing into it."""
    if os.path.lexists(folder / JOURNAL):
        folder = Path(os.path.realpath(folder))
        with folder_lock(folder) as locked:
            go_on(folder, ours, locked)


def go_on(folder: Path, ours: Callable[[str], bool], locked: bool) -> None:
    """End a publication that was cut off, if one was; the caller holds the lock, where there is one.

    `ours` tells of a path in the folder whether we write such a file. Raises OSError, with nothing moved, for
    a journal of another user, with other content, or with a link in one of its paths.
    """
    if not os.path.lexists(folder / JOURNAL):
        return
    try:
        journal = _read_journal(folder, ours)
        holder, names = journal["holder"], (*journal["made"], *journal["dropped"])
        for place in (holder, *names, *(f"{holder}/{name}" for name in names)):
            _is_file(folder, place)  # raises for a link on the way
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OSError) as error:
        said = f"{folder / JOURNAL} was edited or cut short, or is not ours; remove it"
        raise OSError(None, said) from error
    if not locked and os.path.lexists(folder / holder) and at_work(folder / holder):
        raise OSError(None, "another run writes into it now")
    _move(folder, **journal)


def _move(folder: Path, holder: str, made: Sequence[str], dropped: Sequence[str]) -> None:
    """Remove the files `dropped`, rename those `made` out of `holder`; this can be killed, and repeated."""
    for name in dropped:
        if _is_file(folder, name):
            with _opened(folder, name) as (place, own):
                os.unlink(own, dir_fd=place)
    for name in made:
        if _is_file(folder, f"{holder}/{name}"):
            (folder / name).parent.mkdir(exist_ok=True)
            with _opened(folder, f"{holder}/{name}") as (here, old), _opened(folder, name) as (there, new):
                os.replace(old, new, src_dir_fd=here, dst_dir_fd=there)
    os.unlink(folder / JOURNAL)
    remove(folder / holder)


def _read_journal(folder: Path, ours: Callable[[str], bool]) -> dict[str, Any]:
    """Return holder, made and dropped of a journal; ValueError and others where it is none of ours."""
    descriptor = os.open(folder / JOURNAL, os.O_RDONLY | _NOFOLLOW | getattr(os, "O_NONBLOCK", 0))
    with open(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or (hasattr(os, "geteuid") and found.st_uid != os.geteuid()):
            raise ValueError("no file of this user")
        journal: dict[str, Any] = json.loads(file.read(JOURNAL_BYTES))
    names = [*journal["made"], *journal["dropped"]]
    if len(journal) != 3 or "/" in journal["holder"] or not is_hidden_path(Path(journal["holder"])):
        raise ValueError("other content")
    if not all(map(ours, names)) or any({"", ".", ".."} & {*name.split("/")} for name in names):
        raise ValueError("other names")
    return journal


_NOFOLLOW = getattr(os, "O_NOFOLLOW", 0)
_FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)


@contextmanager
def _opened(root: Path, name: str) -> Iterator[tuple[int | None, str]]:
    """Give the opened folder of a path in `root`, and the name in it; NotADirectoryError for a link."""
    *above, own = name.split("/")
    if os.stat not in os.supports_dir_fd:  # Windows opens no folders, and makes links for administrators only
        yield None, str(root / name)
        return
    descriptor = os.open(root, _FOLDER)
    try:
        for part in above:
            outer = descriptor
            descriptor = os.open(part, _FOLDER | _NOFOLLOW, dir_fd=outer)
            os.close(outer)
        yield descriptor, own
    finally:
        os.close(descriptor)


def _is_file(root: Path, name: str) -> bool:
    """Return whether there is a file, or a link, of a path in `root`; NotADirectoryError like `_opened`."""
    with suppress(FileNotFoundError), _opened(root, name) as (folder, own):
        return not stat.S_ISDIR(os.lstat(own, dir_fd=folder).st_mode)
    return False


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
        with folder_lock(target) as locked:
            go_on(target, set(_files(staging, target)).__contains__, locked)
            publish(staging, target)
