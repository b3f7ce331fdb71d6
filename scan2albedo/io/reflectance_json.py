"""`reflectance.json`: what a folder that a `reflectance` command wrote holds, and its figures."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scan2albedo.io.result_json import Figures, Record

REFLECTANCE_FILE = "reflectance.json"


class ReflectanceRecord(Record):
    """The content of `reflectance.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    command: Literal["olat", "fit", "build", "sample", "fit-image", "finetune"]
    inputs: tuple[str, ...] = Field(description="Files, as given.")
    options: Figures = Field(description="What the command was called with.")
    metrics: Figures
    notes: tuple[str, ...] = ()
    files: tuple[str, ...] = Field((), description="Names of the files beside this one.")
