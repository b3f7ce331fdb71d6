"""JSON files that people edit, read with errors that name the file and its first fault."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from scan2albedo.errors import Scan2AlbedoError

Content = TypeVar("Content", bound=BaseModel)


def read_checked(
    path: str | Path,
    kind: type[Content],
    *,
    what: str,
    writer: str,
    schema: str,
    error: type[Scan2AlbedoError],
) -> Content:
    """Return the content of a JSON file of the given kind.

    Parameters
    ----------
    path : str or Path
    kind : type of BaseModel
    what : str
        The thing in the file, for messages, such as "key points".
    writer : str
        Function that writes such files.
    schema : str
        File in data_schemas.
    error : type of Scan2AlbedoError
        To raise.

    Raises
    ------
    Scan2AlbedoError
        Of the given type, when the file cannot be read or does not fit.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as cause:
        raise error(f"{what} {path}: {cause.strerror or cause}; give a file that {writer} wrote") from cause
    except UnicodeDecodeError as cause:
        raise error(f"{what} {path} is no text file; give a JSON file") from cause
    return checked_content(
        text, kind, place=f"{what} {path}", advice=f"expected data_schemas/{schema}", error=error
    )


def checked_content(
    text: str | bytes,
    kind: type[Content],
    *,
    place: str,
    advice: str,
    error: type[Scan2AlbedoError],
    whole: str = "the file",
) -> Content:
    """Return what JSON text holds.

    Parameters
    ----------
    text : str or bytes
    kind : type of BaseModel
    place : str
        What it was read from, for messages, such as "key points glasses.json".
    advice : str
        What it should have been, or what to do, for messages.
    error : type of Scan2AlbedoError
        To raise.
    whole : str
        The text in words, for messages on no part of it.

    Raises
    ------
    Scan2AlbedoError
        Of the given type, when the text does not fit; names the first fault.
    """
    try:
        return kind.model_validate_json(text)
    except ValidationError as cause:
        first = cause.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or whole
        raise error(f"{place}: {where}: {first['msg']} ({cause.error_count()} problems); {advice}") from cause
