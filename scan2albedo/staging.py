"""Hidden folders in which a result grows until it is whole."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def staging_folder(out: Path, name: str) -> Iterator[Path]:
    """Give a hidden folder in `out` that is gone, whatever happens, when the block ends.

    Raises
    ------
    OSError
        When it cannot be created.
    """
    staging = Path(tempfile.mkdtemp(prefix=f".{name}-{os.getpid()}-", suffix=".part", dir=out))
    try:
        yield staging
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def remove_unfinished(out: Path) -> None:
    """Remove the staging folders that this process has in `out`, for an exit that unwinds nothing."""
    for staging in out.glob(f".*-{os.getpid()}-*.part"):
        shutil.rmtree(staging, ignore_errors=True)
