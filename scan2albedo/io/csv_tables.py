"""Texts, lists and CSV tables that people write, read so that every fault is named with its place."""

import csv
from io import StringIO
from pathlib import Path

from scan2albedo.errors import Scan2AlbedoError, ScanError, one_line
from scan2albedo.io.limits import TABLE_BYTES, require_file


def read_text(
    file: Path, *, what: str, advice: str, error: type[Scan2AlbedoError], limit: int = TABLE_BYTES
) -> str:
    """Return the text of a UTF-8 file; raises `error`, which calls it `what`, for more or others."""
    try:
        data = file.read_bytes() if require_file(file, limit) else b""
    except (OSError, ScanError) as cause:
        reason = one_line(cause)
        for name in (str(file), file.name):
            reason = reason.removeprefix(f"{name}: ")
        raise error(f"{what} cannot be read ({reason}); {advice}") from cause
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise error(f"{what} is UTF-16 text; save it in UTF-8, a table as CSV")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        byte = f"byte {cause.start} is {data[cause.start]:#04x}"
        raise error(f"{what} is no UTF-8 text ({byte}); save it in UTF-8, a table as CSV") from cause
    if "\0" in text:
        raise error(f"{what} is not a text file; {advice}")
    return text


def table_rows(text: str, file: Path, error: type[Scan2AlbedoError]) -> list[tuple[int, list[str]]]:
    """Return the rows that hold something with the numbers of their lines; `error` for wrong quotes."""
    # The header shows whether commas, semicolons or tabs separate cells.
    first = next((line for line in text.splitlines() if line.strip()), "")
    reader = csv.reader(StringIO(text, newline=""), delimiter=max(",;\t", key=first.count), strict=True)
    try:
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as cause:
        raise error(f"{file}, line {reader.line_num}: {cause}; mend its quotes") from cause


def cells_by_column(
    header: list[str], row: list[str], where: str, error: type[Scan2AlbedoError]
) -> dict[str, str]:
    """Return the cells of a row, empty where it is short; raises `error` when it has too many."""
    if len(row) > len(header):
        said = f"{where}: has {len(row)} cells, the header {len(header)}"
        raise error(f"{said}; put a cell that holds a separator in quotes")
    return dict.fromkeys(header, "") | dict(zip(header, row, strict=False))
