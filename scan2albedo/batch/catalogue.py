"""`catalogue.parquet`: one row a scan, with columns of fixed names and types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scan2albedo.batch.layout import CATALOGUE
from scan2albedo.batch.manifest import BatchManifest, ManifestScan
from scan2albedo.batch.records import FILES, FIXED, METRICS, STAGES, BatchScanRecord, path_column
from scan2albedo.errors import BatchError, needs_extra
from scan2albedo.io.atomic import atomic_path
from scan2albedo.io.result_records import column_name, metric_columns

if TYPE_CHECKING:
    import pyarrow

NOT_RUN = "not run"


def catalogue_table(manifest: BatchManifest, rows: Mapping[str, BatchScanRecord]) -> pyarrow.Table:
    """Return the catalogue of a batch: a row for each scan of the manifest, in its order.

    `rows` are by name, of the scans that were tried. Columns are those of `records`, figures of stages that
    only some scans have, and the manifest's own as text. Numbers are float64, empty where a scan has none.
    """
    import pyarrow as pa

    lines = [_line(scan, rows.get(scan.name)) for scan in manifest.scans]
    types = _types(manifest, lines)
    schema = pa.schema([(name, _arrow_type(kind)) for name, kind in types.items()])
    columns = {name: [_as(line.get(name), kind) for line in lines] for name, kind in types.items()}
    return pa.Table.from_pydict(columns, schema=schema)


def write_catalogue(path: Path, table: pyarrow.Table) -> None:
    """Write a catalogue, whole or not at all; raises `OutputError` when the folder cannot be written."""
    import pyarrow.parquet as parquet

    with atomic_path(path) as temporary:
        parquet.write_table(table, temporary)


def load_catalogue(out: str | Path) -> pyarrow.Table:
    """Return the catalogue of a batch, one row a scan; `.to_pandas()` makes a data frame of it.

    Parameters
    ----------
    out : path
        Folder of the batch, or its catalogue.parquet.

    Raises
    ------
    BatchError
        When there is none, or it is damaged.
    MissingDependencyError
        When pyarrow is not installed.
    """
    with needs_extra("batch"):
        import pyarrow as pa
        import pyarrow.parquet as parquet

    path = Path(out)
    path = path / CATALOGUE if path.is_dir() else path
    try:
        return parquet.read_table(path)
    except FileNotFoundError as error:
        raise BatchError(f"{path}: no such file; give the folder that `scan2albedo batch` wrote") from error
    except (OSError, pa.ArrowInvalid) as error:
        raise BatchError(
            f"{path}: is no whole catalogue ({error}); `batch --resume` makes it anew"
        ) from error


def _line(scan: ManifestScan, row: BatchScanRecord | None) -> dict[str, Any]:
    line: dict[str, Any] = {"name": scan.name, "source": scan.source, "status": NOT_RUN, "reason": ""}
    line |= scan.extra
    if row is None:
        return line
    line |= {name: getattr(row, name) for name in FIXED if hasattr(row, name)}
    line |= {"source": scan.source, "plan_ran": ", ".join(row.plan_ran)}
    line |= {"plan_skipped": ", ".join(row.plan_skipped), "notes": "; ".join(row.notes)}
    line["folder"] = scan.name if row.status == "done" else None
    line |= {f"seconds_{column_name(stage)}": seconds for stage, seconds in row.timings_s.items()}
    line |= metric_columns(row.metrics)
    return line | {path_column(file): f"{scan.name}/{file}" for file in FILES if file in row.files}


def _types(manifest: BatchManifest, lines: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the columns in order, with the kind of each."""
    types = dict(FIXED) | {f"seconds_{stage}": "float64" for stage in STAGES}
    types |= {path_column(file): "string" for file in FILES} | METRICS
    own = set(types) | set(manifest.extra_columns)
    for line in lines:
        for name, value in line.items():
            if name not in own:
                truth = isinstance(value, bool) and types.get(name, "bool") == "bool"
                types[name] = "bool" if truth else "float64"
    return types | dict.fromkeys(manifest.extra_columns, "string")


def _arrow_type(kind: str) -> Any:
    import pyarrow as pa

    kinds = {"string": pa.string(), "float64": pa.float64(), "bool": pa.bool_()}
    return kinds.get(kind) or pa.timestamp("us", tz="UTC")


def _as(value: Any, kind: str) -> Any:
    if value is None or kind not in ("float64", "bool"):
        return value
    return float(value) if kind == "float64" else bool(value)
