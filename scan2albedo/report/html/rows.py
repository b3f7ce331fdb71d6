"""One row a scan: its figures as flat columns, from `result.json` files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.result_json import ResultRecord, read_record

RESULT_FILE = "result.json"
DONE, FAILED, NOT_RUN = "done", "failed", "not run"


@dataclass(frozen=True)
class ScanRow:
    """One scan of a batch.

    Parameters
    ----------
    name : str
    status : str
        "done", "failed" or "not run".
    reason : str
        Why it is not done.
    folder : Path or None
        Of its files.
    values : mapping of str to object
        Further columns, named as in `catalogue.parquet`: numbers, text, or None.
    """

    name: str
    status: str
    reason: str = ""
    folder: Path | None = None
    values: Mapping[str, Any] = field(default_factory=dict)

    def number(self, column: str) -> float | None:
        """Return a finite number of a column, or None."""
        value = self.values.get(column)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        return float(value) if abs(value) < float("inf") else None


def result_folders(out: Path) -> list[Path]:
    """Return the folders in `out` that hold a result.json, by name; hidden ones do not count."""
    try:
        inside = sorted(path for path in out.iterdir() if path.is_dir() and not path.name.startswith("."))
    except OSError as error:
        raise Scan2AlbedoError(f"{out}: cannot be read: {error.strerror or error}") from error
    return [path for path in inside if (path / RESULT_FILE).is_file()]


def rows_of_folders(folders: list[Path]) -> list[ScanRow]:
    """Return a row for each folder; a result.json that cannot be read becomes a failure with that reason."""
    rows = []
    for folder in folders:
        try:
            record = read_record(folder / RESULT_FILE, ResultRecord)
        except Scan2AlbedoError as error:
            rows.append(ScanRow(folder.name, FAILED, " ".join(str(error).split()), folder))
        else:
            rows.append(row_of_record(record, folder))
    return rows


def row_of_record(record: ResultRecord, folder: Path) -> ScanRow:
    """Return the row of one result."""
    values: dict[str, Any] = {"source": record.input.file, "input_sha256": record.input.sha256}
    seconds = record.metrics.get("seconds")
    values["seconds"] = sum(record.timings_s.values()) if seconds is None else seconds
    values.update(flattened({k: v for k, v in record.metrics.items() if k != "seconds"}, "metrics"))
    values.update({f"seconds_{stage}": seconds for stage, seconds in record.timings_s.items()})
    for column, ran in (("plan_ran", True), ("plan_skipped", False)):
        values[column] = ", ".join(step.stage for step in record.plan if step.ran is ran)
    return ScanRow(record.name, DONE, "", folder, values)


def flattened(tree: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return the leaves of nested mappings by their joined names; of a list of numbers its greatest.

    >>> flattened({"fit": {"residual_mean_mm": 0.1, "deviations": [1, 2]}}, "metrics")
    {'metrics_fit_residual_mean_mm': 0.1, 'metrics_fit_deviations': 2}
    """
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}_{key}"
        if isinstance(value, Mapping):
            leaves.update(flattened(value, name))
        elif isinstance(value, list | tuple):
            numbers = [v for v in value if isinstance(v, int | float)]
            if numbers:
                leaves[name] = max(numbers)
        else:
            leaves[name] = value
    return leaves
