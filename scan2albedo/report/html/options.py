"""What a caller of `write_report` chooses, and what comes back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ReportOptions:
    """Settings of `write_report`.

    Raises
    ------
    ValueError
        For a number out of range.
    """

    scans: int = 40
    """How many scans of a batch get a section of their own."""
    rows: int = 10_000
    """How many scans the table of a batch holds at most."""
    texture_size: int = 1024
    """Longest side of the textures of a single scan; those of its geometry image when that is smaller."""
    batch_texture_size: int = 256
    """The same for each scan of a batch."""
    residual: bool = True
    """Measure a single scan's distance to its fit again when the input still lies where it lay: no file of a
    result holds it for each vertex."""

    def __post_init__(self) -> None:
        for name, least in (("scans", 0), ("rows", 1), ("texture_size", 8), ("batch_texture_size", 8)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}, expected {least} or more")


@dataclass(frozen=True)
class WrittenReport:
    """Where a report is and what it tells."""

    path: Path
    """Of the page."""
    scans: int
    """In the table, or 1."""
    done: int
    """Of them."""
    failed: int
    """Of them."""
    sections: int
    """Scans that have a section of their own."""
    size_bytes: int
    """Of the page."""
