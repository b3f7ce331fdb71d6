"""NPZ files: written whole, and read with one error that names the file, whatever is wrong with it."""

import math
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from numpy.lib.npyio import NpzFile
from pydantic import BaseModel

from scan2albedo.core.arrays import NDArray
from scan2albedo.errors import Scan2AlbedoError, ScanError, one_line
from scan2albedo.io import limits
from scan2albedo.io.atomic import atomic_path
from scan2albedo.io.records import Content, parse_record

Arrays = dict[str, NDArray]


def write_npz(
    path: str | Path,
    arrays: Mapping[str, NDArray],
    *,
    what: str,
    compression: int = 0,
    plain: Collection[str] = (),
) -> None:
    """Write arrays, by name, as an .npz file, whole or not at all; same content, same bytes.

    Messages call the content `what`, such as "reflectance model". `compression` is the level of zlib, 0 for
    none: 6 is worth its time where values repeat, as in masks and indices; measured floats hardly shrink, and
    arrays named in `plain` are not compressed.
    Raises ValueError when the name does not end in .npz, OutputError when the file cannot be written.
    """
    if Path(path).suffix != ".npz":
        raise ValueError(f"{what}s are written as .npz, got {Path(path).name}")
    method = zipfile.ZIP_DEFLATED if compression else zipfile.ZIP_STORED
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", method, compresslevel=compression) as archive,
    ):
        for name, array in arrays.items():
            archive.compression = zipfile.ZIP_STORED if name in plain else method
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(array), allow_pickle=False)


def read_npz(
    path: str | Path,
    names: Collection[str] | None = None,
    *,
    optional: Collection[str] = (),
    what: str,
    advice: str,
    error: type[Scan2AlbedoError],
) -> Arrays:
    """Return arrays of an .npz file by `names` (all when omitted), and those of `optional` that it has.

    Raises `error` when the file is missing, damaged, something else, or lacks an array of `names`; its
    message calls the content `what` and ends with `advice`.
    """
    try:
        # A stream of our own: NumPy leaves the file open where it is damaged.
        size = limits.require_file(Path(path), math.inf)
        with Path(path).open("rb") as stream:
            stored = np.load(stream, allow_pickle=False)
            if not isinstance(stored, NpzFile):
                raise ValueError("it holds a single array, no archive of them")
            with stored:
                there = [name for name in optional if name in stored.files]
                wanted = stored.files if names is None else (*names, *there)
                # What arrays declare is looked at before any is read.
                assert stored.zip is not None
                entries = {entry.filename.removesuffix(".npy"): entry for entry in stored.zip.infolist()}
                # A geometry image of 4096 x 4096 texels has 1.3 GB.
                total = 0
                most = max(3 * limits.FILE_BYTES, limits.GROWTH * size)
                for name in wanted:
                    with stored.zip.open(entries[name]) as member:
                        # NumPy reads headers of versions 2 and 3 alike.
                        first = np.lib.format.read_magic(member) == (1, 0)
                        formats = np.lib.format
                        read = formats.read_array_header_1_0 if first else formats.read_array_header_2_0
                        shape, _, dtype = read(member)
                    needed, held = math.prod(shape) * dtype.itemsize, entries[name].file_size
                    if needed > held:
                        raise ValueError(f"{name} declares {needed:,} bytes and holds {held:,}")
                    total += needed
                if total > most:
                    raise ValueError(f"its arrays have {total:,} bytes, more than the {most:,} that are read")
                return {name: stored[name] for name in wanted}
    except (ScanError, *limits.DAMAGE) as cause:
        raise error(f"{what} {path} cannot be read ({one_line(cause)}); {advice}") from cause


def write_npz_record(
    path: str | Path, header: BaseModel, arrays: Mapping[str, NDArray], *, what: str
) -> None:
    """Write arrays with a record beside them, uncompressed; see `write_npz`."""
    write_npz(path, {"header": np.array(header.model_dump_json()), **arrays}, what=what)


def read_npz_record(
    path: str | Path,
    kind: type[Content],
    arrays: Mapping[str, str],
    *,
    optional: Mapping[str, str] | None = None,
    what: str,
    advice: str,
    error: type[Scan2AlbedoError],
) -> tuple[Content, Arrays]:
    """Return record and arrays of a file that `write_npz_record` wrote; see `read_npz`.

    `arrays` and `optional` map the names of the arrays to the letters of the kinds of dtype they may have.
    """
    kinds = {**arrays, **(optional or {})}
    names = ("header", *arrays)
    found = read_npz(path, names, optional=optional or (), what=what, advice=advice, error=error)
    header = parse_record(
        str(found.pop("header")), kind, place=f"{what} {path}", whole="the header", advice=advice, error=error
    )
    for name, array in found.items():
        if array.dtype.kind not in kinds[name]:
            raise error(f"{what} {path}: {name} holds {array.dtype}; write it again")
    return header, found
