"""Where a batch keeps its files below OUT."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scan2albedo.batch.records import BatchScanRecord
from scan2albedo.errors import BatchError, Scan2AlbedoError
from scan2albedo.io.atomic import make_folder, write_text
from scan2albedo.io.records import read_record, write_record

CATALOGUE, RECORD = "catalogue.parquet", "batch.json"


class Layout:
    """Paths of a batch, all absolute: `out` with `catalogue` and `record`, and below it the records of scans
    that were tried in `rows`, and marks of those that are being processed in `running`."""

    def __init__(self, out: str | Path) -> None:
        self.out = Path(os.path.normpath(Path(out).absolute()))
        self.catalogue, self.record = self.out / CATALOGUE, self.out / RECORD
        self.kept = self.out / ".batch"
        self.rows, self.running = self.kept / "rows", self.kept / "running"
        self.folders = (self.out, self.rows, self.running)  # in which files are made under hidden names
        self._run = self.kept / "run"  # names the only run whose workers may write here

    def row_file(self, name: str) -> Path:
        """Return where the record of a scan is."""
        return self.rows / f"{name}.json"

    def row(self, name: str) -> BatchScanRecord | None:
        """Return the record of a scan, None when it is missing or incomplete."""
        with suppress(Scan2AlbedoError):
            return read_record(self.row_file(name), BatchScanRecord)
        return None

    def keep(self, row: BatchScanRecord) -> None:
        """Write the record of a scan, whole or not at all."""
        make_folder(self.rows)
        write_record(self.row_file(row.name), row)

    def begin_run(self, run: str) -> None:
        """Make `run` the only one whose workers may write here."""
        make_folder(self.rows)
        self.end_run()
        make_folder(self.running)
        write_text(self._run, run)

    def end_run(self) -> None:
        """Keep remaining workers from writing here, and remove their marks."""
        with suppress(OSError):
            self._run.unlink()
        with suppress(OSError):
            for name in os.listdir(self.running):
                if self.started_at(name) is not None:
                    self.unmark(name)
            self.running.rmdir()

    def is_running(self, run: str) -> bool:
        """Return whether `run` is the one that may write here."""
        with suppress(OSError):
            return self._run.read_text(encoding="utf-8") == run
        return False

    def mark(self, name: str, started_at: float) -> None:
        """Note that a scan is being processed by this process since `started_at` (seconds since 1970)."""
        write_text(self.running / name, json.dumps({"pid": os.getpid(), "started_at": started_at}))

    def started_at(self, name: str) -> float | None:
        """Return when processing of a scan began, None when it is not in progress."""
        mark = self.running / name
        with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
            if mark.is_file():  # a pipe may never end
                return float(json.loads(mark.read_text(encoding="utf-8"))["started_at"])
        return None

    def unmark(self, name: str) -> None:
        """Remove the mark of a scan."""
        with suppress(OSError):
            (self.running / name).unlink()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other batches out of the folder during the block; BatchError when one works there already."""
        import fcntl

        lock = make_folder(self.kept) / "lock"
        try:
            descriptor = os.open(lock, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            raise BatchError(f"{lock}: cannot be opened: {error.strerror}; remove it") from error
        try:
            with suppress(OSError):  # a file system without locks
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise BatchError(f"a batch works in {self.out}; wait, or choose another folder") from None
            yield
        finally:
            os.close(descriptor)
