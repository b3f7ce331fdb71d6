"""Faces and scans to measure on that are not part of the repository."""

from __future__ import annotations

from pathlib import Path

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def face_data(name: str) -> Path:
    """Return the path of a file of `DATA`.

    Raises
    ------
    SystemExit
        When it is not there.
    """
    path = DATA / name
    if not path.is_file():
        raise SystemExit(
            f"{path}: no such file; this command measures on faces that are not part of the repository"
        )
    return path
