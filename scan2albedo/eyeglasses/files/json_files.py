"""What the JSON files of eyeglasses share: their units, and how they are read."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from scan2albedo.errors import EyeglassesError
from scan2albedo.io.records import Content, read_record

LengthUnit = Literal["mm", "cm", "m"]
LengthUnitIfKnown = Literal["mm", "cm", "m", "unknown"]


def read_json(
    path: str | Path, kind: type[Content], what: str, *, writer: str, schema: str, hint: str = ""
) -> Content:
    """Return the content of a file that the function `writer` wrote; errors call it `what`, name its schema.

    A `hint` ends the errors' advice. Raises EyeglassesError when the file cannot be read or does not fit.
    """
    advice = f"give a file that {writer} wrote (data_schemas/{schema}.schema.json){hint and '; ' + hint}"
    return read_record(path, kind, what=what, advice=advice, error=EyeglassesError)
