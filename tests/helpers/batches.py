"""Options of batches, and what became of their scans."""

from scan2albedo.batch import load_catalogue
from scan2albedo.pipeline.options import ProcessOptions

TINY = ProcessOptions(model="none", size=32, unit="mm", pictures=False, quality="draft", lights=1)
"""For balls; done as soon as can be."""


def stamps(folder):
    """Return when each file in a folder was last changed."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def statuses(out):
    """Return what became of the scans of a batch, by their names."""
    return {row["name"]: row["status"] for row in load_catalogue(out).to_pylist()}
