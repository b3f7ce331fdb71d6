"""Files and result folders appear whole or not at all."""

import json
import os
import signal
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


def publish(staging: Path, target: Path, dropped: Collection[str], last: Collection[str] = ()) -> None:
    """Put the files of the folder `staging` into the folder `target`, all or none.

    Where there is no `target` yet, one rename makes it. Else its files of the same names are replaced, those
    named in `dropped`, by paths in it, go, and others stay: files are renamed one by one under `JOURNAL`,
    those named in `last` at the end. The caller holds `folder_lock(target)`. Raises OSError, and OutputError
    for a link or a file in the place of a folder, with `target` as it was.
    """
    made = sorted(_moves(staging, target), key=lambda name: name in last)
    with signals_held():
        if not os.path.lexists(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(staging, target)
            return
        holder = hidden_path(target / target.name)
        try:
            holder.mkdir(mode=0o700)
            new, old = holder / "new", holder / "old"
            os.rename(staging, new)
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
    whose they are. Of an `out` that is new the hidden folder is made in `staged_in`, beside `out` when
    omitted. `records` come last. Raises OutputError, naming `out` and the cause, when it cannot be written,
    or a folder in it is a link.
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
