"""Templates as NPZ files: coefficients, masks and a header with their persons and options."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from scan2albedo.errors import RecognitionError
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.recognition.options import Channel, TemplateOptions
from scan2albedo.recognition.templates import Chart, Kind, Templates

_ARRAYS = {"coefficients": "c", "mask": "b"}
"""Names of the arrays in a file and their kinds."""


class TemplateOptionsRecord(BaseModel):
    """How the templates were made; see `TemplateOptions`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: int | None = Field(ge=1)
    scales: int = Field(ge=1)
    orientations: int = Field(ge=2, le=16)
    channel: Channel
    hole_radius: float = Field(ge=0, lt=0.5)
    unit_mean: bool


class ChartRecord(BaseModel):
    """The chart that the images lie on; see `Chart`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str | None = Field(description="Name of the face model; null where unknown.")
    shape: tuple[int, int] = Field(description="Height and width of the images in texels.")


class TemplatesHeader(BaseModel):
    """The text "header" in a file of templates, as JSON."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["scan2albedo templates"] = "scan2albedo templates"
    format_version: Literal[1] = 1
    names: tuple[str, ...] = Field(min_length=1, description="Of the templates' persons, in order.")
    options: TemplateOptionsRecord
    kind: Kind = Field("albedo", description="What the templates are of.")
    chart: ChartRecord | None = Field(None, description="Of the images; null where unknown.")


def write_templates(path: str | Path, templates: Templates) -> None:
    """Write templates as an NPZ file, whole or not at all.

    330 kB a template of an albedo of 256 pixels, three times that of a shape; not compressed, for the bits of
    coefficients do not repeat.

    Parameters
    ----------
    path : str or Path
        Ends in .npz.
    templates : Templates

    Raises
    ------
    ValueError
        When the name does not end in .npz.
    RecognitionError
        When there is no template.
    OutputError
        When the file cannot be written.
    """
    if len(templates) == 0:
        raise RecognitionError("there is no template to write; give one or more")
    options = TemplateOptionsRecord.model_validate(templates.options, from_attributes=True)
    chart = None if templates.chart is None else ChartRecord(**vars(templates.chart))
    header = TemplatesHeader(names=templates.names, options=options, chart=chart, kind=templates.kind)
    arrays = {name: getattr(templates, name) for name in _ARRAYS}
    write_npz_record(path, header, arrays, what="template")


def read_templates(path: str | Path) -> Templates:
    """Return the templates of a file that `write_templates` wrote.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    RecognitionError
        When the file is missing, damaged, something else, or holds templates that cannot be used; names it.
    """
    header, arrays = read_npz_record(
        path,
        TemplatesHeader,
        _ARRAYS,
        what="templates",
        advice="give a file that write_templates wrote (data_schemas/template_set.schema.json)",
        error=RecognitionError,
    )
    try:
        options = TemplateOptions(**header.options.model_dump())
        chart = None if header.chart is None else Chart(**header.chart.model_dump())
        return Templates(arrays["coefficients"], arrays["mask"], header.names, options, chart, header.kind)
    except (ValueError, RecognitionError) as error:
        raise RecognitionError(f"templates {path}: {error}; write the file again") from error
