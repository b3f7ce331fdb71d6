"""`catalogue.parquet`, one row a scan with columns of fixed names and types, and the albedos it lists."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2albedo.batch.manifest import BatchManifest
from scan2albedo.batch.records import CATALOGUE, FILES, FIXED, METRICS, STAGES, BatchScanRecord, path_column
from scan2albedo.core.arrays import BoolArray, Float32Array, Values
from scan2albedo.errors import BatchError, errors_of, needs_extra
from scan2albedo.geometry.rasterization import area_mean
from scan2albedo.io.atomic import atomic_path
from scan2albedo.io.images import read_image_linear
from scan2albedo.io.npz import read_npz
from scan2albedo.io.publication import check_whole
from scan2albedo.io.result_records import column_name, metric_columns

if TYPE_CHECKING:
    import pyarrow


def catalogue_table(manifest: BatchManifest, rows: Mapping[str, BatchScanRecord]) -> pyarrow.Table:
    """Return the catalogue of a batch: a row for each scan of the manifest, in its order.

    Of `rows`, by name, come the columns of `records` and further figures as float64; the manifest's are text.
    """
    import pyarrow as pa

    own = set(manifest.extra_columns)
    types = dict(FIXED) | {f"seconds_{stage}": "float64" for stage in STAGES}
    types |= {path_column(file): "string" for file in FILES} | METRICS
    known = set(types) | own
    lines = []
    for scan in manifest.scans:
        line: Values = {"name": scan.name, "source": scan.source, "status": "not run", "reason": ""}
        line |= scan.extra
        if (row := rows.get(scan.name)) is not None:
            line |= {name: getattr(row, name) for name in FIXED if hasattr(row, name)}
            line |= {"source": scan.source, "plan_ran": ", ".join(row.plan_ran)}
            line |= {"plan_skipped": ", ".join(row.plan_skipped), "notes": "; ".join(row.notes)}
            line["folder"] = scan.name if row.status == "done" else None
            line |= {f"seconds_{column_name(stage)}": seconds for stage, seconds in row.timings_s.items()}
            line |= metric_columns(row.metrics)
            line |= {path_column(file): f"{scan.name}/{file}" for file in FILES if file in row.files}
        lines.append(line)
        for name, value in line.items():
            if name not in known:
                truth = isinstance(value, bool) and types.get(name, "bool") == "bool"
                types[name] = "bool" if truth else "float64"
    types |= dict.fromkeys(manifest.extra_columns, "string")
    kinds = {"string": pa.string(), "float64": pa.float64(), "bool": pa.bool_()}
    kinds["timestamp"] = pa.timestamp("us", tz="UTC")
    casts = {"float64": float, "bool": bool}
    for line in lines:
        for name, cell in line.items():
            if cell is not None and types[name] in casts:
                line[name] = casts[types[name]](cell)
    return pa.Table.from_pylist(lines, schema=pa.schema([(n, kinds[kind]) for n, kind in types.items()]))


def write_catalogue(path: Path, table: pyarrow.Table) -> None:
    """Write a catalogue, whole or not at all."""
    import pyarrow.parquet as parquet

    with atomic_path(path) as temporary:
        parquet.write_table(table, temporary)


def load_catalogue(out: str | Path) -> pyarrow.Table:
    """Return the catalogue of a batch, one row a scan; `.to_pandas()` makes a data frame of it.

    `out` is the folder of the batch, or its catalogue.parquet. Raises BatchError when there is none, or it is
    damaged, and MissingDependencyError when pyarrow is not installed.
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
        raise BatchError(f"{path}: is no whole catalogue ({error}); `batch --resume` redoes it") from error


def load_albedos(out: str | Path, size: int | None = None) -> tuple[list[str], Float32Array, BoolArray]:
    """Return the albedos of all scans of a batch that are done and have one.

    Raises BatchError when there is no such batch, no albedo, scans of several models or sizes, or a file is
    missing; ScanError when an albedo is damaged.

    Parameters
    ----------
    out : path
        Folder of the batch.
    size : int, optional
        Height and width to bring them to, by averages over the texels that were seen; as stored when omitted.

    Returns
    -------
    names : list of str
        Of the scans, in the manifest's order.
    albedo_linear : (N, size, size, 3) float32
        Texels correspond between scans of one face model; those of scans without a model do not.
    masks : (N, size, size) bool
        Texels that the scanner saw; others have the colour of the closest point of the scan.
    """
    table, anew = load_catalogue(out), "`batch --resume` makes it anew"
    columns = ("name", "model", "status", "path_albedo_exr")
    if missing := [name for name in columns if name not in table.column_names]:
        raise BatchError(f"{out}: its catalogue has no column {missing[0]}; {anew}")
    folder = Path(out) if Path(out).is_dir() else Path(out).parent
    rows = table.select(columns).to_pylist()
    wanted = [row for row in rows if row["status"] == "done" and row["path_albedo_exr"]]
    if not wanted:
        raise BatchError(f"{folder}: no scan of this batch has an albedo; see the reasons in its catalogue")
    if len(models := sorted({row["model"] for row in wanted})) > 1:
        raise BatchError(
            f"{folder}: scans of several models ({', '.join(models)}), whose texels do not correspond; "
            "process them in a batch each"
        )
    albedos: list[Float32Array] = []
    masks: list[BoolArray] = []
    for row in wanted:
        path = str(row["path_albedo_exr"])
        file = folder / path
        if ".." in Path(path).parts or len(Path(path).parts) != 2 or file.parent.is_symlink():
            raise BatchError(f"{folder}: its catalogue names {path!r}, no file of a scan in it; {anew}")
        with errors_of(f"{file.parent}: cannot be read", BatchError, OSError):
            check_whole(file.parent)
        albedo, image = read_image_linear(file), file.parent / "geometry_image.npz"
        arrays = read_npz(
            image,
            ("mask",),
            optional=("texture_valid",),
            what="geometry image",
            advice="run the batch with --resume",
            error=BatchError,
        )
        seen = arrays["mask"] & arrays.get("texture_valid", True)
        if seen.shape != albedo.shape[:2]:
            raise BatchError(f"{file}: has {albedo.shape[:2]} texels, {image.name} {seen.shape}: of two runs")
        if size is not None and albedo.shape[:2] != (size, size):
            # Means over the texels that were seen, over all where none was.
            square = (size, size)
            weight = area_mean(seen, square)
            some = (weight > 0)[..., None]
            weighted = area_mean(albedo * seen[..., None], square) / np.where(some, weight[..., None], 1)
            albedo = np.where(some, weighted, area_mean(albedo, square)).astype(np.float32)
            seen = weight >= 0.5
        if albedos and albedo.shape != albedos[0].shape:
            raise BatchError(
                f"{folder}: {row['name']} has {albedo.shape[:2]} texels, {wanted[0]['name']} "
                f"{albedos[0].shape[:2]}; give a size"
            )
        albedos.append(albedo)
        masks.append(seen)
    return [row["name"] for row in wanted], np.stack(albedos), np.stack(masks)
