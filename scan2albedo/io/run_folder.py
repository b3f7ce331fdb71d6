"""`RunFolder`: the one way in which a command guards, writes and reads its folder of results."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Generic, TypeVar

from PIL.Image import Image

from scan2albedo.core.arrays import Texts
from scan2albedo.core.budget import Trace
from scan2albedo.core.version import VERSION
from scan2albedo.errors import OutputError, Scan2AlbedoError
from scan2albedo.io.atomic import cannot_write
from scan2albedo.io.leftovers import is_hidden_path
from scan2albedo.io.publication import folder_lock, go_on, publish, settle, staged
from scan2albedo.io.records import Record, installed_versions, read_record, write_record

Kind = TypeVar("Kind", bound=Record)


@dataclass(frozen=True)
class OwnFiles(Generic[Kind]):
    """The names that a command may write into a folder, and the record that lists which of them it wrote."""

    record: str
    """Name of the record's file."""
    kind: type[Kind]
    """Of the record; it has a field `files`."""
    names: Texts
    """Names of the other files; * and ? stand for any characters."""
    command: str = "scan2albedo"
    """Who writes them, for messages."""
    inside: OwnFiles[Any] | None = None
    """Of the folders in the folder, if there are some."""
    whole_folder: bool = False
    """The user did not name the folder itself: it may be no link, and if not empty it must have a record."""

    def holds(self, name: str) -> bool:
        """Return whether the command may write a file of this name."""
        plain = "/" not in name and "\\" not in name
        return plain and (name == self.record or any(fnmatchcase(name, known) for known in self.names))

    def holds_path(self, path: str) -> bool:
        """Return whether the command may write a file of this path, in the folder or in a folder in it."""
        below, _, name = path.rpartition("/")
        files = self.inside if below else self
        return "/" not in below and files is not None and files.holds(name)

    def listed(self, folder: Path) -> tuple[frozenset[str], str]:
        """Return the names of the files in a folder that an earlier run wrote; if none, why."""
        path = folder / self.record
        if path.is_symlink():
            return frozenset(), f"its {self.record} is a link"
        if not path.exists():
            return frozenset(), f"no {self.record}"
        try:
            files = getattr(read_record(path, self.kind), "files", ())
        except Scan2AlbedoError as error:
            return frozenset(), str(error)
        # A record may have been edited: it names no file that such a run does not write.
        return frozenset({self.record, *filter(self.holds, files)}), ""


@dataclass(frozen=True)
class Staging(Generic[Kind]):
    """The hidden folder in which the files of a run are made."""

    folder: Path
    files: OwnFiles[Kind]

    def trace(self, trace: Trace) -> None:
        """Write a trace as a table, trace.csv, and as a picture, error_vs_time.png."""
        trace.to_csv(self.folder / "trace.csv")
        trace.plot().savefig(self.folder / "error_vs_time.png")

    def picture(self, name: str, picture: Image) -> None:
        """Write a picture as PNG."""
        picture.save(self.folder / name, compress_level=1)

    def write_record(self, **content: Any) -> Kind:
        """Write the record with this content, versions and the list of files, and return it; call it last."""
        fields = self.files.kind.model_fields
        if "versions" in fields:
            content["versions"] = installed_versions()
        if "scan2albedo_version" in fields:
            content["scan2albedo_version"] = VERSION
        names = sorted(path.name for path in self.folder.iterdir() if path.is_file())
        record = self.files.kind.model_validate(content | {"files": (*names, self.files.record)})
        write_record(self.folder / self.files.record, record)
        return record


class RunFolder(Generic[Kind]):
    """A folder of results, guarded by one rule: a file that no run of the command wrote stays as it is.

    A run wrote what its record lists, and `also`, names known from elsewhere.

    >>> import tempfile
    >>> from scan2albedo.io.result_records import RunRecord
    >>> class Greeting(RunRecord):
    ...     files: Texts = ()
    >>> folder = RunFolder(Path(tempfile.mkdtemp()), OwnFiles("greeting.json", Greeting, ("hello_*.txt",)))
    >>> _ = folder.check()  # before the work
    >>> with folder.publishing() as staging:
    ...     _ = (staging.folder / "hello_1.txt").write_text("hello")
    ...     _ = staging.write_record()
    >>> folder.read().files
    ('hello_1.txt', 'greeting.json')
    """

    def __init__(self, path: str | Path, files: OwnFiles[Kind], also: Collection[str] = ()) -> None:
        self.path, self.files, self._also = Path(path), files, also

    def check(self, subfolders: Collection[str] = ()) -> frozenset[str]:
        """Return the files of earlier runs here and in the `subfolders` of a run, by their paths in it.

        Raises OutputError for a file that no run wrote under our names, and for a link instead of a folder.
        """
        own: set[str] = set()
        with cannot_write(self.path):
            settle(self.path, self.files.holds_path)
            for below in ("", *sorted(subfolders)):
                files = self.files.inside if below else self.files
                assert files is not None, f"{self.files.command} writes a folder {below}"
                folder = self.path / below
                if folder.is_symlink() and (below or files.whole_folder):
                    raise OutputError(f"{folder}: is a link to a folder, which is not followed; remove it")
                if not os.path.lexists(folder):
                    continue
                there = [name for name in sorted(os.listdir(folder)) if not is_hidden_path(folder / name)]
                listed, fault = files.listed(folder)
                if not below:
                    listed |= {name for name in self._also if files.holds(name)}
                if files.whole_folder and there and not listed:
                    said = f"{folder}: is not empty, and no run of {files.command} wrote it ({fault})"
                    advice = "nothing in it is touched: move it away, or choose another folder"
                    raise OutputError(f"{said}; {advice}")
                for name in sorted(there, key=lambda name: name != files.record):
                    if files.holds(name) and name not in listed:
                        raise OutputError(
                            f"{folder}: holds {name}, which no run of {files.command} wrote"
                            f"{fault and f' ({fault})'}; move it away, or choose another folder"
                        )
                own |= {f"{below}/{name}" if below else name for name in listed}
        return frozenset(own)

    @contextmanager
    def publishing(self) -> Iterator[Staging[Kind]]:
        """Give a hidden folder whose files replace those of earlier runs when the block ends well.

        See `publish`. Raises OutputError like `check`, and when the folder cannot be written.
        """
        self.check()
        target = Path(os.path.realpath(self.path))
        with cannot_write(self.path), staged(target) as folder:
            yield Staging(folder, self.files)
            folders = [path.name for path in folder.iterdir() if path.is_dir()]
            names = {path.name for path in folder.iterdir()}.difference(folders)
            unknown = [name for name in names if not self.files.holds(name)]
            assert not unknown, f"{self.files.command} writes {unknown}, which OwnFiles does not name"
            with folder_lock(target) as locked:
                go_on(target, self.files.holds_path, locked)
                publish(folder, target, self.check(folders))

    def read(self, error: type[Scan2AlbedoError] = Scan2AlbedoError) -> Kind:
        """Return the record; raises `error` like `read_record`."""
        return read_record(self.path / self.files.record, self.files.kind, error=error)
